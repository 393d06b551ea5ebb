//! Ground-truth sampling: objects of other frames are pasted in, with their points, where they touch nothing.

use crate::{Frame, GtDatabase, Object, Stream};
use geometry::{Box3, bev_intersection, points_in_boxes};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// How much is pasted, and of what.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct GtSamplingConfig {
    /// Paste objects of other frames.
    pub enabled: bool,
    /// Objects drawn for a frame, by class; what collides is dropped.
    pub per_class: BTreeMap<String, usize>,
    /// Count the objects that are there already: draw only what is missing to `per_class`.
    pub limit_whole_scene: bool,
    /// Objects with fewer points are never pasted.
    pub min_points: usize,
    /// Leave out objects that are harder than KITTI's "hard", as far as image boxes say so.
    pub drop_too_hard: bool,
}

impl Default for GtSamplingConfig {
    fn default() -> Self {
        GtSamplingConfig {
            enabled: true,
            per_class: ["Car", "Pedestrian", "Cyclist"].map(|class| (class.into(), 15)).into(),
            limit_whole_scene: false,
            min_points: 5,
            drop_too_hard: true,
        }
    }
}

/// Margin of a pasted box when the points of the scene inside it are removed, m; the reference's CPU routine has the same.
const REMOVE_MARGIN_M: f64 = 1e-2;

/// Pastes objects of the database. A drawn object that touches an object of the frame, of whatever class, or another one of the same draw is
/// dropped. Points of the scene inside pasted boxes go away, pasted points come first, pasted objects last.
///
/// The reference walks through a shuffled list from frame to frame; here each frame draws without replacement, so that what it gets
/// depends on its own stream alone.
pub fn sample_gt(mut frame: Frame, config: &GtSamplingConfig, database: &GtDatabase, stream: &mut Stream) -> Frame {
    let mut boxes: Vec<Box3> = frame.objects.iter().map(|o| o.bbox).collect();
    let there = boxes.len();
    let mut pasted_values = Vec::new();
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
            boxes.push(sample.bbox);
            for p in sample.points.chunks_exact(database.channels()) {
                pasted_values.extend((0..3).map(|i| (f64::from(p[i]) + sample.bbox.center[i]) as f32));
                pasted_values.extend(&p[3..]);
            }
            frame.objects.push(Object {
                class: class.clone(),
                bbox: sample.bbox,
                truncation: None,
                occlusion: None,
                image_box: None,
            });
        }
    }
    let mut covered = vec![false; frame.cloud.len()];
    for k in
        points_in_boxes(&frame.cloud.values, frame.cloud.channels, &boxes[there..], REMOVE_MARGIN_M).iter().flatten()
    {
        covered[*k as usize] = true;
    }
    frame.cloud.retain(|k, _| !covered[k]);
    frame.cloud.values.splice(..0, pasted_values);
    frame
}
