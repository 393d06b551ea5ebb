//! Ground-truth sampling: pastes objects of other frames, with their points, where they do not collide.

use crate::{DataError, Frame, GroundConfig, GroundHeight, GtDatabase, Object, Stream};
use geometry::{Box3, bev_intersection, points_in_boxes};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Configuration of ground-truth sampling.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct GtSamplingConfig {
    /// Paste objects of other frames.
    pub enabled: bool,
    /// Number of objects drawn for a frame, by class. Objects that collide are dropped.
    pub per_class: BTreeMap<String, usize>,
    /// Count the objects of the frame: draw only as many as are missing to `per_class`.
    pub limit_whole_scene: bool,
    /// Objects with fewer points are never pasted.
    pub min_points: usize,
    /// Leave out objects that are harder than KITTI's level "hard". Objects without an image box are kept.
    pub drop_too_hard: bool,
    /// Paste objects at the height above the ground that they had, as OpenPCDet does with road planes. Without it they
    /// keep their z, which suits level ground.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ground: Option<GroundConfig>,
}

impl Default for GtSamplingConfig {
    fn default() -> Self {
        GtSamplingConfig {
            enabled: true,
            per_class: ["Car", "Pedestrian", "Cyclist"].map(|class| (class.into(), 15)).into(),
            limit_whole_scene: false,
            min_points: 5,
            drop_too_hard: true,
            ground: None,
        }
    }
}

/// Margin around a pasted box within which points of the scene are removed, m. As in OpenPCDet's CPU routine.
const REMOVE_MARGIN_M: f64 = 1e-2;

/// Pastes objects of the database into a frame.
///
/// A drawn object is dropped if its box overlaps, seen from above, an object of the frame, an object already pasted,
/// or another object drawn for the same class. Points of the scene inside pasted boxes are removed. Pasted points are
/// inserted before the points of the scene, pasted objects after the objects of the scene.
///
/// With `ground` the database holds heights above the ground, and the ground of this frame is added.
///
/// Difference to OpenPCDet, which consumes one shuffled list over all frames: here each frame draws without replacement
/// from the whole database, so the result depends on the frame's random stream only.
///
/// # Errors
/// A database whose file cannot be read.
pub fn sample_gt(
    mut frame: Frame,
    config: &GtSamplingConfig,
    database: &GtDatabase,
    stream: &mut Stream,
) -> Result<Frame, DataError> {
    let mut boxes: Vec<Box3> = frame.objects.iter().map(|o| o.bbox).collect();
    let first_pasted = boxes.len();
    let mut pasted_values = Vec::new();
    let ground = config.ground.as_ref().map(|ground| GroundHeight::of(&frame.cloud, ground));
    for (class, wanted) in &config.per_class {
        let samples = database.samples(class);
        let present = frame.objects.iter().filter(|o| o.class == *class).count();
        let wanted = if config.limit_whole_scene { wanted.saturating_sub(present) } else { *wanted };
        let drawn = rand::seq::index::sample(stream, samples.len(), wanted.min(samples.len())).into_vec();
        let drawn: Vec<_> = drawn.into_iter().map(|i| &samples[i]).collect();
        let touches = |a: &Box3, b: &Box3| bev_intersection(a, b) > 0.0;
        let free = |i: usize| {
            let bbox = &drawn[i].bbox;
            let others = drawn.iter().enumerate().filter(|(j, _)| *j != i).map(|(_, s)| &s.bbox);
            !boxes.iter().chain(others).any(|other| touches(bbox, other))
        };
        let free: Vec<_> = (0..drawn.len()).filter(|i| free(*i)).map(|i| drawn[i]).collect();
        for sample in free {
            let mut bbox = sample.bbox;
            let [x, y, z] = &mut bbox.center;
            *z += ground.as_ref().map_or(0.0, |ground| ground.at(*x, *y));
            boxes.push(bbox);
            for p in database.points(sample)?.chunks_exact(database.channels()) {
                pasted_values.extend((0..3).map(|i| (f64::from(p[i]) + bbox.center[i]) as f32));
                pasted_values.extend(&p[3..]);
            }
            frame.objects.push(Object {
                class: class.clone(),
                bbox,
                truncation: None,
                occlusion: None,
                image_box: None,
            });
        }
    }
    let mut covered = vec![false; frame.cloud.len()];
    for k in points_in_boxes(&frame.cloud.values, frame.cloud.channels, &boxes[first_pasted..], REMOVE_MARGIN_M)
        .iter()
        .flatten()
    {
        covered[*k as usize] = true;
    }
    frame.cloud.retain(|k, _| !covered[k]);
    frame.cloud.values.splice(..0, pasted_values);
    Ok(frame)
}
