//! Checks of a data set: reads every frame once and reports what would break or distort a training or an evaluation.

mod detector_fit;
mod duplicates;
mod ground;
mod interpretation;
mod report;
mod statistics;
mod survey;

pub use report::{ClassFacts, DOCTOR_SCHEMA, DoctorReport, Finding, PointFacts, Severity, Spread};

use crate::{DataError, Dataset};
use rayon::prelude::*;
use report::{Findings, at_most};
use schemars::JsonSchema;
use serde::Serialize;
use std::collections::{BTreeMap, HashSet};
use survey::{FrameFacts, survey};

/// What a detector expects of its data.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct DetectorFacts {
    /// Classes that it detects.
    pub classes: Vec<String>,
    /// `[x_min, y_min, z_min, x_max, y_max, z_max]`, m, LiDAR frame.
    pub range: [f64; 6],
    /// Its anchors; empty for a detector without anchors.
    pub anchors: Vec<AnchorFacts>,
}

/// The anchors of one class.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct AnchorFacts {
    /// The class.
    pub class: String,
    /// Length, width, height, m.
    pub size: [f64; 3],
    /// z of the bottom face, m, LiDAR frame.
    pub bottom: f64,
}

/// Maximum number of frames on which interpretations of the labels are compared. More frames do not change the result.
const MAX_INTERPRETED_FRAMES: usize = 300;

/// Checks a data set and, if given, whether it fits a detector. An error only if the frames cannot be listed;
/// everything else is a finding.
pub fn doctor(dataset: &Dataset, detector: Option<&DetectorFacts>) -> Result<DoctorReport, DataError> {
    let ids = dataset.all_ids()?;
    let mut findings = Findings::default();
    let splits = splits(dataset, &ids, &mut findings);

    let stride = ids.len().div_ceil(MAX_INTERPRETED_FRAMES);
    let outcomes: Vec<Result<FrameFacts, DataError>> =
        ids.par_iter().enumerate().map(|(i, id)| survey(dataset, id, i % stride == 0)).collect();
    let mut frames = Vec::new();
    let mut bad = Vec::new();
    for (id, outcome) in ids.iter().zip(outcomes) {
        match outcome {
            Ok(facts) => frames.push(facts),
            Err(error) => bad.push((id.clone(), error.to_string())),
        }
    }
    if !bad.is_empty() {
        let messages: Vec<_> = bad.iter().map(|(_, message)| message.clone()).collect();
        let message = format!("{} of {} frames cannot be used: {}", bad.len(), ids.len(), at_most(5, &messages, "; "));
        findings.problem("bad files", message, bad.into_iter().map(|(id, _)| id));
    }

    let classes = statistics::classes(dataset, &frames, &mut findings);
    let points = statistics::points(&frames, &mut findings);
    statistics::ground(&frames, &mut findings);
    let readings = interpretation::compare(dataset, &frames, &mut findings);
    duplicates::compare(&frames, &splits, &mut findings);
    if let Some(detector) = detector {
        detector_fit::compare(dataset, detector, &frames, &mut findings);
    }
    Ok(DoctorReport::new(dataset, &ids, &frames, splits, points, classes, readings, findings))
}

/// The frame ids of every split that can be read. Errors of the lists become findings.
fn splits(dataset: &Dataset, all: &[String], findings: &mut Findings) -> BTreeMap<String, Vec<String>> {
    let mut splits = BTreeMap::new();
    for name in dataset.config.splits.keys() {
        match dataset.ids(name) {
            Ok(ids) => {
                let mut seen = HashSet::new();
                let twice: Vec<_> = ids.iter().filter(|id| !seen.insert(*id)).cloned().collect();
                if !twice.is_empty() {
                    let message = format!(
                        "the split {name:?} lists {} frames more than once: {}",
                        twice.len(),
                        at_most(5, &twice, ", ")
                    );
                    findings.problem("splits", message, twice);
                }
                splits.insert(name.clone(), ids);
            }
            Err(error) => findings.problem("splits", error.to_string(), []),
        }
    }
    if dataset.config.splits.is_empty() {
        findings.note(
            "splits",
            "there are no splits: train on all frames, or write ImageSets/train.txt, val.txt and test.txt".into(),
            [],
        );
    } else {
        let listed: HashSet<_> = splits.values().flatten().collect();
        let unlisted: Vec<_> = all.iter().filter(|id| !listed.contains(id)).cloned().collect();
        if !unlisted.is_empty() {
            let message = format!("{} of {} frames are in no split", unlisted.len(), all.len());
            findings.note("splits", message, unlisted);
        }
    }
    splits
}

#[cfg(test)]
mod tests;
