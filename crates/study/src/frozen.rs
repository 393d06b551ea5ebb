//! Detectors that were trained elsewhere: their detections are read or made, checked, scored, and compared between data
//! sets of the same frames.

mod axes;
mod checkpoint;
mod paired;
mod results;
mod source;

pub use checkpoint::detect_frozen;
pub use results::read_result_frames;

use crate::config::{ELSEWHERE, FrozenDetector};
use crate::data_sets::{labelled_sha256, open};
use crate::error::{InPart, Result, refused};
use crate::folder::Study;
use crate::written::CellFiles;
use crate::{Event, Listener};
use axes::check_axes;
use data::Presence as _;
use data::write_json;
use eval::EvalFrame;
use eval::matrix::{PairedValues, RunId, RunResult, RunScores, ScoredFrames, TestSet, paired_values};
use paired::check_shared_frames;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use source::Source;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};

/// Inputs of the checked detections of a frozen detector on a data set. Written to `cell.json` after the check.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub(crate) struct FrozenCell {
    schema: String,
    detector: FrozenDetectorKey,
    test_set: String,
    split: String,
    frames: usize,
    labels_sha256: String,
    source_sha256: String,
    /// The files of a checkpoint's detections; none if they were made elsewhere, and in cells of text files, which
    /// version 1 had.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    files: Option<CellFiles>,
}

/// What of a frozen detector changes its detections, besides their files.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
struct FrozenDetectorKey {
    name: String,
    classes: BTreeMap<String, String>,
    ignored_classes: Vec<String>,
}

/// Version of [`FrozenCell`].
pub(crate) const CELL_SCHEMA: &str = "lidarshift/frozen-cell/2";

impl FrozenCell {
    fn path(study: &Study, frozen: &FrozenDetector, test_set: &str) -> PathBuf {
        frozen.detections_folder(study, test_set).join("cell.json")
    }
}

impl FrozenDetector {
    /// Its folder in the folder of the study.
    pub fn folder(&self, study: &Study) -> PathBuf {
        study.folder.join("frozen").join(&self.name)
    }

    /// Folder of `cell.json` and, for a checkpoint, of the detections on a data set.
    fn detections_folder(&self, study: &Study, test_set: &str) -> PathBuf {
        self.folder(study).join("detections").join(test_set)
    }

    /// Folder of all refined regions of a two-stage network on a data set.
    fn regions_folder(&self, study: &Study, test_set: &str) -> PathBuf {
        self.folder(study).join("regions").join(test_set)
    }

    /// Folders of the detections and of the regions on a data set.
    fn cell(&self, study: &Study, test_set: &str) -> [PathBuf; 2] {
        [self.detections_folder(study, test_set), self.regions_folder(study, test_set)]
    }

    /// Its run in the matrix.
    pub fn run_id(&self) -> RunId {
        RunId { network: self.name.clone(), train_set: ELSEWHERE.into(), seed: 0 }
    }
}

/// The `cell.json` that up-to-date detections have.
fn expected_cell(study: &Study, frozen: &FrozenDetector, test_set: &str) -> Result<FrozenCell> {
    let dataset = open(study, test_set)?;
    let ids = dataset.ids(&study.config.splits.test)?;
    let source_sha256 = match (&frozen.checkpoint, frozen.detections.get(test_set)) {
        (Some(checkpoint), _) => checkpoint::checkpoint_sha256(study, frozen, checkpoint)?,
        (None, Some(path)) => source::source_sha256(&study.path(path))
            .in_part(|| format!("frozen {}: detections on {test_set}", frozen.name))?,
        (None, None) => return Err(refused(format!("frozen {} has no detections on {test_set}", frozen.name))),
    };
    Ok(FrozenCell {
        schema: CELL_SCHEMA.into(),
        detector: FrozenDetectorKey {
            name: frozen.name.clone(),
            classes: frozen.classes.clone(),
            ignored_classes: frozen.ignored_classes.clone(),
        },
        test_set: test_set.into(),
        split: study.config.splits.test.clone(),
        frames: ids.len(),
        labels_sha256: labelled_sha256(&dataset, &ids)?,
        source_sha256,
        files: None,
    })
}

/// Whether the detections on a data set have been checked, or made, with the present files.
fn is_done(study: &Study, frozen: &FrozenDetector, test_set: &str) -> Result<bool> {
    let Ok(bytes) = fs_err::read(FrozenCell::path(study, frozen, test_set)) else { return Ok(false) };
    let Ok(mut found) = serde_json::from_slice::<FrozenCell>(&bytes) else { return Ok(false) };
    let files = found.files.take();
    found.schema = CELL_SCHEMA.into();
    if found != expected_cell(study, frozen, test_set)? {
        return Ok(false);
    }
    if frozen.checkpoint.is_none() {
        return Ok(true);
    }
    let ids = open(study, test_set)?.ids(&study.config.splits.test)?;
    Ok(CellFiles::are_there(files.as_ref(), &frozen.cell(study, test_set), &ids))
}

/// The test frames of a data set with labels and the detections of a frozen detector, in the label frame.
fn read_frames(study: &Study, frozen: &FrozenDetector, test_set: &str, labels: &TestSet) -> Result<Vec<EvalFrame>> {
    let Some(path) = frozen.detections.get(test_set) else {
        CellFiles::verify(&frozen.cell(study, test_set))?;
        let mut frames = labels.with_detections(&frozen.detections_folder(study, test_set))?;
        for frame in &mut frames {
            frame.detections = frozen.in_classes_of_labels(std::mem::take(&mut frame.detections));
        }
        return Ok(frames);
    };
    let dataset = open(study, test_set)?;
    let source = Source { frozen, path: study.path(path), dataset: &dataset, test_set, labels };
    source.read(&evaluated_classes(study))
}

fn evaluated_classes(study: &Study) -> Vec<String> {
    let mut classes = study.config.evaluation.matrix.classes.clone();
    classes.push(study.config.evaluation.analysis.class.clone());
    classes
}

/// Reads and checks the detections of all frozen detectors, and makes those of checkpoints, unless they are up to date.
/// `device` are the command line arguments of the device.
///
/// # Errors
/// Data sets without shared frames; detections that cannot be read, do not fit the frames or classes of their data set,
/// or are in another frame than its labels; a checkpoint that cannot be used.
pub(crate) fn prepare(study: &Study, device: &[String], listener: Listener<'_>) -> Result<()> {
    for frozen in &study.config.frozen {
        check_shared_frames(study, frozen)?;
    }
    for frozen in &study.config.frozen {
        let mut missing = Vec::new();
        for dataset in study.config.datasets.iter().filter(|d| frozen.is_tested_on(&d.name)) {
            if !is_done(study, frozen, &dataset.name)? {
                missing.push(&dataset.name);
            }
        }
        if frozen.checkpoint.is_some() {
            if !missing.is_empty() {
                checkpoint::run_process(study, frozen, device, listener)?;
            }
            continue;
        }
        for test_set in missing {
            listener(Event::Note(&format!("frozen {}: reading its detections on {test_set}", frozen.name)));
            let labels = TestSet::read(&open(study, test_set)?, &study.config.splits.test)?;
            let frames = read_frames(study, frozen, test_set, &labels)?;
            check_axes(study, frozen, test_set, &labels, &frames)?;
            let cell = expected_cell(study, frozen, test_set)?;
            write_json(&FrozenCell::path(study, frozen, test_set), &cell)?;
        }
    }
    Ok(())
}

/// A frozen detector on a data set: the hash of its inputs, or why there are no detections.
pub(crate) struct FrozenCellState {
    name: String,
    test_set: String,
    state: Result<String, String>,
}

/// The state of all frozen detectors.
#[derive(Default)]
pub struct FrozenState {
    cells: Vec<FrozenCellState>,
    /// Scores that have been computed in this process, by detector and data set.
    scores: Mutex<BTreeMap<(String, String), Arc<RunScores>>>,
}

impl FrozenState {
    /// Reads the state of every frozen detector on every data set.
    ///
    /// # Errors
    /// A missing data set.
    pub fn read(study: &Study) -> Result<FrozenState> {
        let mut cells = Vec::new();
        for frozen in &study.config.frozen {
            for dataset in &study.config.datasets {
                let state = if !frozen.is_tested_on(&dataset.name) {
                    Err("the study has no detections of it on this data set".to_string())
                } else {
                    match is_done(study, frozen, &dataset.name) {
                        Ok(true) => {
                            let cell = expected_cell(study, frozen, &dataset.name)?;
                            Ok(format!("{} {:?}", cell.source_sha256, cell.detector))
                        }
                        Ok(false) => Err("its detections have not been read yet, or have changed since".to_string()),
                        Err(error) => Err(error.to_string()),
                    }
                };
                cells.push(FrozenCellState { name: frozen.name.clone(), test_set: dataset.name.clone(), state });
            }
        }
        Ok(FrozenState { cells, ..FrozenState::default() })
    }

    /// Name of each detector and data set, and why there are no detections.
    pub fn lines(&self) -> impl Iterator<Item = (&str, &str, Option<&str>)> {
        self.cells.iter().map(|c| (c.name.as_str(), c.test_set.as_str(), c.state.as_ref().err().map(String::as_str)))
    }

    /// Everything that determines the results.
    pub(crate) fn key(&self) -> String {
        self.cells.iter().map(|c| format!("{} {} {:?}\n", c.name, c.test_set, c.state)).collect()
    }

    /// Whether there are detections.
    pub(crate) fn has(&self, name: &str, test_set: &str) -> bool {
        self.cells.iter().any(|c| c.name == name && c.test_set == test_set && c.state.is_ok())
    }

    /// Compares the detections of checkpoints with their checksums.
    ///
    /// # Errors
    /// A file that was changed.
    pub(crate) fn verify(&self, study: &Study) -> Result<()> {
        for cell in self.cells.iter().filter(|cell| cell.state.is_ok()) {
            let frozen = study.config.frozen_detector(&cell.name);
            if let Some(frozen) = frozen.filter(|frozen| frozen.checkpoint.is_some()) {
                CellFiles::verify(&frozen.cell(study, &cell.test_set))?;
            }
        }
        Ok(())
    }

    /// The results for the matrix on a data set, by run and data set.
    pub(crate) fn results(&self, study: &Study, labels: &TestSet, test_set: &str) -> Vec<((RunId, String), RunResult)> {
        let of_cell = |cell: &FrozenCellState| {
            let frozen = study.config.frozen_detector(&cell.name)?;
            let result = match &cell.state {
                Ok(_) => self.scores(study, frozen, test_set, labels).map_err(|e| e.to_string()),
                Err(reason) => Err(reason.clone()),
            };
            Some(((frozen.run_id(), test_set.to_string()), result.map(|scores| (*scores).clone())))
        };
        self.cells.iter().filter(|cell| cell.test_set == test_set).filter_map(of_cell).collect()
    }

    fn scores(
        &self,
        study: &Study,
        frozen: &FrozenDetector,
        test_set: &str,
        labels: &TestSet,
    ) -> Result<Arc<RunScores>> {
        let key = (frozen.name.clone(), test_set.to_string());
        let known = |scores: &BTreeMap<_, Arc<RunScores>>| scores.get(&key).cloned();
        if let Some(scores) = known(&self.scores.lock().unwrap_or_else(PoisonError::into_inner)) {
            return Ok(scores);
        }
        let frames = read_frames(study, frozen, test_set, labels)?;
        let folder = frozen.regions_folder(study, test_set);
        let regions = if frozen.checkpoint.is_some() && folder.may_be_folder() {
            Some(labels.with_detections(&folder)?)
        } else {
            None
        };
        let options = &study.config.evaluation.matrix;
        let scores = Arc::new(labels.scores(&frames, regions.as_deref(), options));
        self.scores.lock().unwrap_or_else(PoisonError::into_inner).insert(key, scores.clone());
        Ok(scores)
    }

    /// All values of a frozen detector on these data sets over the frames that all of them have, and the number of
    /// these frames.
    ///
    /// # Errors
    /// Labels or detections that cannot be read or have changed.
    pub(crate) fn values(
        &self,
        study: &Study,
        frozen: &FrozenDetector,
        names: &[&str],
    ) -> Result<(usize, Vec<PairedValues>)> {
        let mut sets = Vec::new();
        for name in names {
            if !self.has(&frozen.name, name) {
                return Err(refused(format!(
                    "frozen {}: its detections on {name} changed while they were read",
                    frozen.name
                )));
            }
            sets.push(self.scored(study, frozen, name)?);
        }
        let sets: Vec<ScoredFrames> = sets.iter().map(|(ids, scores)| ScoredFrames::new(scores, ids)).collect();
        Ok(paired_values(&sets, &study.config.evaluation.matrix))
    }

    /// The test frames of a data set and the scores on them.
    fn scored(&self, study: &Study, frozen: &FrozenDetector, name: &str) -> Result<(Vec<String>, Arc<RunScores>)> {
        let labels = TestSet::read(&open(study, name)?, &study.config.splits.test)?;
        let ids = labels.frames().iter().map(|frame| frame.id.clone()).collect();
        Ok((ids, self.scores(study, frozen, name, &labels)?))
    }

    /// The test frames of a data set with labels and the detections of a frozen detector; `None` without detections.
    ///
    /// # Errors
    /// Labels or detections that cannot be read.
    pub(crate) fn frames(
        &self,
        study: &Study,
        frozen: &FrozenDetector,
        test_set: &str,
        labels: &TestSet,
    ) -> Result<Option<Vec<EvalFrame>>> {
        match self.has(&frozen.name, test_set) {
            true => read_frames(study, frozen, test_set, labels).map(Some),
            false => Ok(None),
        }
    }
}
