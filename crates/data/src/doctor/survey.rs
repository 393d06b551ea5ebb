//! The one pass over the data: everything that later checks need of a frame, small enough to keep for all of them.

use super::duplicates::Signature;
use super::ground::Ground;
use super::reading::{Evidence, evidence};
use crate::{DataError, Dataset};
use geometry::{Box3, points_in_boxes};

/// A frame in numbers.
pub(super) struct FrameFacts {
    pub(super) id: String,
    pub(super) points: usize,
    /// `[x_min, y_min, z_min, x_max, y_max, z_max]`, m.
    pub(super) range: [f64; 6],
    pub(super) intensity: Option<[f64; 2]>,
    pub(super) signature: Signature,
    pub(super) objects: Vec<ObjectFacts>,
    /// Points in the boxes under each reading of the labels, for frames that were read in all ways.
    pub(super) evidence: Vec<Evidence>,
}

/// An object in numbers.
pub(super) struct ObjectFacts {
    pub(super) class: String,
    pub(super) bbox: Box3,
    pub(super) points: usize,
    /// Height of the ground around it, m.
    pub(super) ground: Option<f64>,
}

pub(super) fn survey(dataset: &Dataset, id: &str, read_in_all_ways: bool) -> Result<FrameFacts, DataError> {
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
        evidence: if read_in_all_ways { evidence(dataset, id, &lines, &ground) } else { Vec::new() },
    })
}
