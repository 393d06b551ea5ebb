//! Reads a frame once and extracts what the checks need. Clouds are not kept.

use super::duplicates::Signature;
use super::ground::Ground;
use super::interpretation::{InsideCounts, inside_counts};
use crate::{DataError, Dataset};
use geometry::{Box3, points_in_boxes};

/// What the checks need of a frame.
pub(super) struct FrameFacts {
    pub(super) id: String,
    pub(super) points: usize,
    /// `[x_min, y_min, z_min, x_max, y_max, z_max]`, m.
    pub(super) range: [f64; 6],
    pub(super) intensity: Option<[f64; 2]>,
    pub(super) signature: Signature,
    pub(super) objects: Vec<ObjectFacts>,
    /// Points inside each label under all interpretations; empty if the frame was not interpreted.
    pub(super) inside_counts: Vec<InsideCounts>,
}

/// What the checks need of an object.
pub(super) struct ObjectFacts {
    pub(super) class: String,
    pub(super) bbox: Box3,
    pub(super) points: usize,
    /// z of the ground around the object, m, LiDAR frame; `None` if not known.
    pub(super) ground: Option<f64>,
}

/// Reads a frame. `interpret` also counts points under all interpretations of the labels.
pub(super) fn survey(dataset: &Dataset, id: &str, interpret: bool) -> Result<FrameFacts, DataError> {
    let cloud = dataset.load_cloud(id)?;
    let lines = if dataset.has_labels() { dataset.labels(id)? } else { Vec::new() };
    let objects = dataset.objects(id, &lines)?;
    let ground = Ground::new(&cloud);

    let mut range =
        [f64::INFINITY, f64::INFINITY, f64::INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY];
    let mut intensity = [f64::INFINITY, f64::NEG_INFINITY];
    for p in cloud.points() {
        for i in 0..3 {
            range[i] = range[i].min(p[i].into());
            range[i + 3] = range[i + 3].max(p[i].into());
        }
        if let Some(v) = p.get(3) {
            intensity = [intensity[0].min((*v).into()), intensity[1].max((*v).into())];
        }
    }
    let boxes: Vec<Box3> = objects.iter().map(|o| o.bbox).collect();
    let members = points_in_boxes(&cloud.values, cloud.channels, &boxes, 0.0);
    let facts = |(object, members): (&crate::Object, Vec<u32>)| ObjectFacts {
        class: object.class.clone(),
        bbox: object.bbox,
        points: members.len(),
        ground: ground.at(object.bbox.center[0], object.bbox.center[1]),
    };
    Ok(FrameFacts {
        id: id.into(),
        points: cloud.len(),
        range,
        intensity: (cloud.channels > 3).then_some(intensity),
        signature: Signature::of(&cloud, &ground),
        objects: objects.iter().zip(members).map(facts).collect(),
        inside_counts: if interpret { inside_counts(dataset, id, &lines, &ground) } else { Vec::new() },
    })
}
