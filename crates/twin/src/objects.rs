//! Objects of a twin: the returns in the boxes of a track, gathered in the frame of the box.

mod shape;

use crate::map::{FusionConfig, Patch, SurfelMap};
use geometry::{Box3, Pose, upright_pose};
use std::collections::BTreeSet;

/// How far outside of its box returns belong to an object, m: boxes are labelled tightly.
const MARGIN_M: f64 = 0.15;

/// Height above the bottom of a box below which returns are the ground's, m.
const GROUND_M: f64 = 0.1;

/// With fewer returns than this the shape of the class stands for the object.
const FEWEST_RETURNS: usize = 60;

/// A mirrored patch is taken if no own one is this near, m.
const UNSEEN_M: f32 = 0.15;

/// Whether a point belongs to the object in a box. Both in the same frame.
pub fn is_in(bbox: &Box3, point: &[f32; 3]) -> bool {
    is_in_size(bbox.size, bbox.to_local(point.map(f64::from)))
}

/// The same for a point in the frame of the box, whose size is [l, w, h], m.
pub fn is_in_size([l, w, h]: [f64; 3], [x, y, z]: [f64; 3]) -> bool {
    x.abs() <= l / 2.0 + MARGIN_M
        && y.abs() <= w / 2.0 + MARGIN_M
        && (GROUND_M - h / 2.0..=h / 2.0 + MARGIN_M).contains(&z)
}

/// Pose of a box: `frame_from_box`.
pub fn pose_of(bbox: &Box3) -> Pose {
    upright_pose(bbox.center, bbox.yaw_rad)
}

/// Surfels of an object in the frame of its box: from `patches` (in that frame), and where one side was not seen, from
/// the mirror image of the other. With too few returns, the shape of the class in the size of the box.
pub fn model(patches: &[Patch], class: &str, size: [f64; 3], config: &FusionConfig) -> SurfelMap {
    if patches.len() < FEWEST_RETURNS {
        return SurfelMap::build(&shape::patches(class, size), [], config);
    }
    let cell = |p: &[f32; 3]| p.map(|v| (v / UNSEEN_M).floor() as i32);
    let seen: BTreeSet<[i32; 3]> = patches.iter().map(|p| cell(&p.place)).collect();
    let near = |p: &[f32; 3]| {
        let [x, y, z] = cell(p);
        (-1..=1).any(|i| (-1..=1).any(|j| (-1..=1).any(|k| seen.contains(&[x + i, y + j, z + k]))))
    };
    let mirrored = patches.iter().map(Patch::mirrored).filter(|p| !near(&p.place));
    let all: Vec<Patch> = patches.iter().copied().chain(mirrored).collect();
    SurfelMap::build(&all, [], config)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn side(count: usize, y: f32) -> Vec<Patch> {
        let patch = |i: usize| Patch {
            place: [0.1 * (i % 20) as f32 - 1.0, y, 0.1 * (i / 20) as f32 - 0.5],
            normal: [0.0, y.signum(), 0.0],
            axes: [[0.05, 0.0, 0.0], [0.0, 0.0, 0.05]],
            smooth: true,
            range_m: 10.0,
            intensity: 0.4,
            frame: 0,
        };
        (0..count).map(patch).collect()
    }

    #[test]
    fn the_side_that_nobody_saw_is_the_mirror_image() {
        let config = FusionConfig::default();
        let model = model(&side(200, 0.9), "Car", [4.0, 1.8, 1.5], &config);
        let from_right = model.end([0.0, -10.0, 0.0], [0.0, 1.0, 0.0], &mut Vec::new()).unwrap();
        assert!((from_right.range_m - 9.1).abs() < 0.01, "{from_right:?}");
    }

    #[test]
    fn few_returns_give_the_shape_of_the_class_in_the_size_of_the_box() {
        let config = FusionConfig::default();
        for class in ["Car", "Van", "Cyclist", "Pedestrian", "Tram"] {
            let model = model(&side(5, 0.9), class, [4.0, 1.8, 1.5], &config);
            let end = model.end([10.0, 0.01, -0.41], [-1.0, 0.0, 0.0], &mut Vec::new()).expect(class);
            assert!((7.5..9.5).contains(&end.range_m), "{class} {end:?}");
        }
    }

    #[test]
    fn the_ground_below_a_box_is_not_the_objects() {
        let bbox = Box3 { center: [10.0, 0.0, 0.0], size: [4.0, 2.0, 1.6], yaw_rad: 0.0 };
        assert!(
            is_in(&bbox, &[10.0, 1.1, 0.0]) && !is_in(&bbox, &[10.0, 0.0, -0.78]) && !is_in(&bbox, &[10.0, 1.2, 0.0])
        );
    }
}
