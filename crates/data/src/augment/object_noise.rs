//! Noise of single objects: each is translated and rotated with its points, unless that makes it overlap another
//! object.

use super::world::{normal, uniform};
use crate::{Frame, Stream};
use geometry::{Box3, bev_intersection, points_in_boxes};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Configuration of the noise of single objects. Off by default, as in OpenPCDet.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ObjectNoiseConfig {
    /// Standard deviation of the translation along x, y and z, m.
    pub translation_std_m: [f64; 3],
    /// Smallest and largest rotation about the z axis through the object's centre, rad. Drawn uniformly.
    pub rotation_rad: [f64; 2],
    /// Maximum number of attempts to find a pose without overlap. After the last one the object keeps its pose.
    pub tries: usize,
}

impl Default for ObjectNoiseConfig {
    fn default() -> Self {
        ObjectNoiseConfig { translation_std_m: [0.0; 3], rotation_rad: [0.0; 2], tries: 100 }
    }
}

/// Moves the objects one after the other, in their order. A point in two boxes moves with the first box.
pub fn noise_objects(mut frame: Frame, config: &ObjectNoiseConfig, stream: &mut Stream) -> Frame {
    if config.translation_std_m == [0.0; 3] && config.rotation_rad == [0.0; 2] {
        return frame;
    }
    let old: Vec<Box3> = frame.objects.iter().map(|o| o.bbox).collect();
    let mut new = old.clone();
    for i in 0..new.len() {
        for _ in 0..config.tries {
            let mut moved = old[i];
            for (axis, std) in config.translation_std_m.iter().enumerate() {
                moved.center[axis] += std * normal(stream);
            }
            moved.yaw_rad += uniform(config.rotation_rad, stream);
            let free = |(j, other): (usize, &Box3)| j == i || bev_intersection(&moved, other) <= 0.0;
            if new.iter().enumerate().all(free) {
                new[i] = moved;
                break;
            }
        }
    }
    let mut taken = vec![false; frame.cloud.len()];
    for (i, members) in points_in_boxes(&frame.cloud.values, frame.cloud.channels, &old, 0.0).into_iter().enumerate() {
        for k in members.into_iter().map(|k| k as usize) {
            if !std::mem::replace(&mut taken[k], true) {
                let moved = new[i].from_local(old[i].to_local(frame.cloud.xyz(k).map(f64::from)));
                let channels = frame.cloud.channels;
                frame.cloud.values[k * channels..k * channels + 3].copy_from_slice(&moved.map(|v| v as f32));
            }
        }
    }
    for (object, bbox) in frame.objects.iter_mut().zip(new) {
        object.bbox = bbox;
    }
    frame
}

#[cfg(test)]
mod tests {
    use super::super::tests::{members, scene};
    use super::*;
    use crate::stream;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn points_move_with_their_objects_and_objects_do_not_overlap(seed in any::<u64>()) {
            let config = ObjectNoiseConfig { translation_std_m: [1.0, 1.0, 0.5], rotation_rad: [-0.8, 0.8], tries: 100 };
            let frame = scene(seed, 5);
            let noisy = noise_objects(frame.clone(), &config, &mut stream(seed, "n", 0, 0));
            for ((before, after), object) in members(&frame).iter().zip(members(&noisy)).zip(&noisy.objects) {
                prop_assert!(before.iter().all(|k| after.contains(k)));
                prop_assert!(noisy.objects.iter().all(|o| o == object || bev_intersection(&o.bbox, &object.bbox) <= 0.0));
            }
            prop_assert!(noisy.objects[0].bbox != frame.objects[0].bbox);
        }
    }
}
