//! Detectors that are evaluated as they are: detections or a checkpoint made elsewhere.

use super::StudyConfig;
use data::LabelBox;
use eval::matrix::{Place, PlannedNetwork};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

/// Name of the train set of detectors that were trained elsewhere, in the matrix and its files.
pub const ELSEWHERE: &str = "elsewhere";

/// A detector that was trained elsewhere and is only evaluated: either its detections on each data set, or its
/// checkpoint.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct FrozenDetector {
    /// Name of the detector and of its folder.
    pub name: String,
    /// Title in tables and figures. Default: the name.
    pub title: String,
    /// Its detections, by the name of the data set: a folder of KITTI text files (`ID.txt`, 16 values a line, in the
    /// label frame of the data set), a Parquet file of detections or the folder with its `detections.parquet` (in the
    /// label frame as well), or a `result.pkl` of OpenPCDet (boxes in the LiDAR frame). Paths are relative to the
    /// study's TOML. Data sets without an entry are not evaluated.
    pub detections: BTreeMap<String, PathBuf>,
    /// Its weights: a `.pth` of OpenPCDet, or safetensors. Needs `detector`; every data set is evaluated.
    pub checkpoint: Option<PathBuf>,
    /// The detector of the weights: a TOML relative to the study's TOML, or the name of a built-in one.
    pub detector: Option<PathBuf>,
    /// Class names of the detections that are called otherwise in the labels: `{ vehicle = "Car" }`.
    pub classes: BTreeMap<String, String>,
    /// Classes of the detections that are left out.
    pub ignored_classes: Vec<String>,
}

impl FrozenDetector {
    /// Whether it is evaluated on a data set.
    pub fn is_tested_on(&self, dataset: &str) -> bool {
        self.checkpoint.is_some() || self.detections.contains_key(dataset)
    }

    /// The detections with renamed classes, without DontCare and ignored classes.
    pub fn in_classes_of_labels(&self, detections: Vec<LabelBox>) -> Vec<LabelBox> {
        let renamed = |mut detection: LabelBox| {
            if let Some(class) = self.classes.get(&detection.class) {
                detection.class.clone_from(class);
            }
            detection
        };
        let kept = |d: &LabelBox| !d.is_dont_care() && !self.ignored_classes.contains(&d.class);
        detections.into_iter().filter(kept).map(renamed).collect()
    }

    /// Its row of the matrix.
    pub(super) fn planned(&self) -> PlannedNetwork {
        PlannedNetwork {
            network: Place { name: self.name.clone(), title: self.title.clone(), paper: None },
            train_sets: vec![Place::new(ELSEWHERE)],
            seeds: vec![0],
        }
    }

    fn problem(&self, datasets: &[&str]) -> Option<String> {
        let of = format!("frozen {}", self.name);
        let what = match (self.detections.is_empty(), &self.checkpoint, &self.detector) {
            (false, None, None) | (true, Some(_), Some(_)) => None,
            (false, ..) => {
                Some("has detections and a checkpoint or a detector; give either detections, or both others")
            }
            (true, Some(_), None) => Some("has a checkpoint without detector, the TOML or the name of its network"),
            (true, None, _) => Some(
                "has neither detections = { DATASET = \"PATH\" } nor checkpoint = \"FILE\" with detector = \"TOML\"",
            ),
        };
        if let Some(what) = what {
            return Some(format!("{of} {what}"));
        }
        if let Some(name) = self.detections.keys().find(|name| !datasets.contains(&name.as_str())) {
            return Some(format!(
                "{of}: detections contains {name:?}, which is not a data set of the study; known names: {}",
                datasets.join(", ")
            ));
        }
        let known: BTreeSet<&String> = self.classes.keys().collect();
        let twice = self.ignored_classes.iter().find(|class| known.contains(class));
        twice.map(|class| format!("{of}: class {class:?} is renamed by classes and left out by ignored_classes"))
    }
}

impl StudyConfig {
    /// The first problem of the frozen detectors. `networks` are the names of the trained ones.
    pub(super) fn frozen_problem(&self, datasets: &[&str], networks: &[String]) -> Option<String> {
        if let Some(problem) = self.frozen.iter().find_map(|frozen| frozen.problem(datasets)) {
            return Some(problem);
        }
        if let Some(frozen) = self.frozen.iter().find(|f| networks.contains(&f.name)) {
            return Some(format!("frozen {:?} has the name of a trained detector", frozen.name));
        }
        let reserved = [ELSEWHERE, "frozen"].into_iter().find(|name| datasets.contains(name));
        reserved.filter(|_| !self.frozen.is_empty()).map(|name| {
            format!("dataset {name:?}: this name is reserved in a study with frozen detectors; choose another one")
        })
    }

    /// A frozen detector by its name.
    pub fn frozen_detector(&self, name: &str) -> Option<&FrozenDetector> {
        self.frozen.iter().find(|frozen| frozen.name == name)
    }

    /// Whether something is trained.
    pub fn trains(&self) -> bool {
        !self.detectors.is_empty()
    }

    /// The split for distances and statistics of the data sets: that for training, or for testing if nothing is
    /// trained.
    pub fn compared_split(&self) -> &str {
        if self.trains() { &self.splits.train } else { &self.splits.test }
    }
}
