//! Evaluation of the detections of a study: the matrix, and the error analyses of single runs.

use crate::cache::cached;
use crate::config::StudyRun;
use crate::data_sets::{labelled_sha256, open};
use crate::detections::{evenly_spaced, weights_sha256};
use crate::error::Result;
use crate::folder::Study;
use crate::frozen::FrozenState;
use crate::run_state::{RunState, run_state};
use crate::written::CellFiles;
use data::Presence as _;
use data::{DataError, Dataset, LabelBox};
use eval::analysis::{AnalysisOptions, BoxPoints, RunAnalysis, analyse};
use eval::matrix::{Matrix, MatrixOptions, RunId, RunResult, RunScores, TestSet, build};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::PathBuf;

/// The state of all runs of a study, and hashes of its test sets.
pub struct StudyState {
    /// The state of each run.
    pub run_states: Vec<(StudyRun, RunState)>,
    /// Name of each test set and a hash of its frames and labels.
    pub tests: Vec<(String, String)>,
    /// The detectors that were trained elsewhere.
    pub frozen: FrozenState,
}

impl StudyState {
    /// Reads the state of every run and test set.
    ///
    /// # Errors
    /// A missing data set.
    pub fn read(study: &Study) -> Result<StudyState> {
        let runs = study.config.runs().into_iter();
        let run_states = runs.map(|run| Ok((run.clone(), run_state(study, &run)?))).collect::<Result<_>>()?;
        let test = |name: &String| {
            let dataset = open(study, name)?;
            let ids = dataset.ids(&study.config.splits.test)?;
            Ok((name.clone(), labelled_sha256(&dataset, &ids)?))
        };
        let names: Vec<String> = study.config.datasets.iter().map(|d| d.name.clone()).collect();
        let frozen = FrozenState::read(study)?;
        Ok(StudyState { run_states, tests: names.iter().map(test).collect::<Result<_>>()?, frozen })
    }

    /// Whether a run in this state has detections on a test set.
    pub fn has(run_state: &RunState, test_set: &str) -> bool {
        match run_state {
            RunState::Done => true,
            RunState::Trained(missing) => !missing.iter().any(|name| name == test_set),
            _ => false,
        }
    }

    /// Everything that determines the results: the state and the weights of each run, and the test sets.
    ///
    /// # Errors
    /// Weights that cannot be read.
    pub fn key(&self, study: &Study) -> Result<String> {
        let mut key = String::new();
        for (run, run_state) in &self.run_states {
            let weights = match run_state {
                RunState::Done | RunState::Trained(_) => weights_sha256(&run.folder(&study.folder))?,
                _ => String::new(),
            };
            let _ = writeln!(key, "{run} {run_state:?} {weights}");
        }
        for (name, hash) in &self.tests {
            let _ = writeln!(key, "{name} {hash}");
        }
        Ok(key + &self.frozen.key())
    }
}

/// The matrix of a study, cached in `matrix.json`.
///
/// # Errors
/// Labels that cannot be read, and detections that were changed.
pub fn matrix(study: &Study, state: &StudyState) -> Result<Matrix> {
    let options = &study.config.evaluation.matrix;
    let path = study.folder.join("matrix.json");
    cached(&path, &(state.key(study)?, study.config.plan(), options), || {
        let mut results: BTreeMap<(RunId, String), RunResult> = BTreeMap::new();
        state.frozen.verify(study)?;
        for (test_set, _) in &state.tests {
            let tested = state.run_states.par_iter().filter(|(_, run_state)| StudyState::has(run_state, test_set));
            tested.try_for_each(|(run, _)| CellFiles::verify(&run.cell(study, test_set)))?;
            let labels = TestSet::read(&open(study, test_set)?, &study.config.splits.test)?;
            let of_run = |(run, run_state): &(StudyRun, RunState)| {
                let result = if StudyState::has(run_state, test_set) {
                    scores(&labels, &run.cell(study, test_set), options).map_err(|e| e.to_string())
                } else {
                    Err(reason(run_state)?)
                };
                Some(((run.id.clone(), test_set.clone()), result))
            };
            results.extend(state.run_states.par_iter().filter_map(of_run).collect::<Vec<_>>());
            results.extend(state.frozen.results(study, &labels, test_set));
        }
        Ok(build(&study.config.plan(), &results, options))
    })
}

/// Scores of the detections of a run and, for a two-stage network, of its regions.
fn scores(labels: &TestSet, folders: &[PathBuf; 2], options: &MatrixOptions) -> Result<RunScores, DataError> {
    let [detections, regions] = folders;
    let frames = labels.with_detections(detections)?;
    let regions = if regions.may_be_folder() { Some(labels.with_detections(regions)?) } else { None };
    Ok(labels.scores(&frames, regions.as_deref(), options))
}

/// Why a run has no detections; `None` if it has not been executed yet.
fn reason(run_state: &RunState) -> Option<String> {
    match run_state {
        RunState::Failed(reason) => Some(reason.clone()),
        RunState::Other(differences) => {
            Some(format!("its folder holds a run with other settings ({})", differences.join("; ")))
        }
        RunState::Stopped(step, total) => Some(format!("it was stopped at step {step} of {total}")),
        RunState::Running(step, total) => Some(format!("it is being worked on, step {step} of {total}")),
        RunState::Done | RunState::Trained(_) | RunState::Missing => None,
    }
}

/// Error analyses of the first finished run of every network and train set: on the first test set of the study, and on
/// the test set of its training data, against labels and, where they are known, against the true boxes; and of every
/// detector that was trained elsewhere, on each data set. Cached in `analyses.json`.
///
/// # Errors
/// Frames that cannot be read.
pub fn analyses(study: &Study, state: &StudyState) -> Result<Vec<(String, RunAnalysis)>> {
    let key = (state.key(study)?, &study.config.evaluation.analysis);
    cached(&study.folder.join("analyses.json"), &key, || {
        let first = &study.config.datasets[0].name;
        let mut seen = Vec::new();
        let mut out = Vec::new();
        for (run, run_state) in &state.run_states {
            let of = (run.id.network.clone(), run.id.train_set.clone());
            if seen.contains(&of) || !matches!(run_state, RunState::Done) {
                continue;
            }
            let mut tests = vec![first];
            if *first != run.id.train_set {
                tests.push(&run.id.train_set);
            }
            for test_set in tests {
                let title = format!(
                    "{}, {} to {}",
                    network_title(study, &run.id.network),
                    study.title(&run.id.train_set),
                    study.title(test_set)
                );
                let dataset = open(study, test_set)?;
                let labels = TestSet::read(&dataset, &study.config.splits.test)?;
                CellFiles::verify(&run.cell(study, test_set))?;
                let frames = labels.with_detections(&run.detections(&study.folder, test_set))?;
                for reference in labels.known_beside() {
                    let frames = labels.labelled_by(reference, &frames);
                    let title = format!("{title}{}", reference.suffix());
                    out.push((title, analysis(study, &dataset, labels.label_frame, &frames)?));
                }
                out.push((title, analysis(study, &dataset, labels.label_frame, &frames)?));
            }
            seen.push(of);
        }
        for (frozen, test_set) in
            study.config.frozen.iter().flat_map(|f| study.config.datasets.iter().map(move |d| (f, &d.name)))
        {
            let dataset = open(study, test_set)?;
            let labels = TestSet::read(&dataset, &study.config.splits.test)?;
            if let Some(frames) = state.frozen.frames(study, frozen, test_set, &labels)? {
                let title = format!("{}, trained elsewhere, to {}", frozen.title, study.title(test_set));
                for reference in labels.known_beside() {
                    let frames = labels.labelled_by(reference, &frames);
                    let title = format!("{title}{}", reference.suffix());
                    out.push((title, analysis(study, &dataset, labels.label_frame, &frames)?));
                }
                out.push((title, analysis(study, &dataset, labels.label_frame, &frames)?));
            }
        }
        Ok(out)
    })
}

/// The title of a network.
pub fn network_title(study: &Study, network: &str) -> String {
    let plan = study.config.plan();
    plan.networks.into_iter().find(|n| n.network.name == network).map_or(network.into(), |n| n.network.title)
}

fn analysis(
    study: &Study,
    dataset: &Dataset,
    label_frame: data::LabelFrame,
    frames: &[eval::EvalFrame],
) -> Result<RunAnalysis> {
    let options = AnalysisOptions { label_frame, ..study.config.evaluation.analysis.clone() };
    // Points are counted only if the boxes are in the frame of the cloud; boxes in the camera frame are tilted relative
    // to it.
    let points = match label_frame {
        data::LabelFrame::Lidar => Some(points(dataset, frames)?),
        data::LabelFrame::Camera => None,
    };
    Ok(analyse(frames, points.as_deref(), &options))
}

fn points(dataset: &Dataset, frames: &[eval::EvalFrame]) -> Result<Vec<BoxPoints>> {
    let boxes = |lines: &[LabelBox]| lines.iter().map(LabelBox::lidar_box).collect::<Vec<_>>();
    let of_frame = |frame: &eval::EvalFrame| {
        let cloud = dataset.load_cloud(&frame.id)?;
        Ok(BoxPoints::count(&cloud, &boxes(&frame.labels), &boxes(&frame.detections)))
    };
    frames.par_iter().map(of_frame).collect()
}

/// `n` test frames, evenly spaced over the split.
///
/// # Errors
/// A missing split.
pub fn some_test_frames(study: &Study, dataset: &Dataset, n: usize) -> Result<Vec<String>> {
    Ok(evenly_spaced(&dataset.ids(&study.config.splits.test)?, n))
}
