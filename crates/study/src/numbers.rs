//! What the detections of a study say: the matrix, and what is behind the average precision of single runs.

use crate::cache::cached;
use crate::config::StudyRun;
use crate::data_sets::{labelled_sha256, open};
use crate::detections::{spread, weights_sha256};
use crate::error::Result;
use crate::folder::Study;
use crate::standing::{Standing, standing};
use data::{DataError, Dataset, LabelBox};
use eval::analysis::{AnalysisOptions, BoxPoints, RunAnalysis, analyse};
use eval::matrix::{Matrix, MatrixOptions, RunId, RunResult, RunScores, TestSet, build};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::PathBuf;

/// The runs of a study that have detections on a test set, by their names; and why others have none.
pub struct Found {
    /// How each run stands.
    pub standings: Vec<(StudyRun, Standing)>,
    /// Test sets with a hash of their frames and labels.
    pub tests: Vec<(String, String)>,
}

impl Found {
    /// Looks at every run and test set.
    ///
    /// # Errors
    /// A data set that is not there.
    pub fn look(study: &Study) -> Result<Found> {
        let runs = study.config.runs().into_iter();
        let standings = runs.map(|run| Ok((run.clone(), standing(study, &run)?))).collect::<Result<_>>()?;
        let test = |name: &String| {
            let dataset = open(study, name)?;
            let ids = dataset.ids(&study.config.splits.test)?;
            Ok((name.clone(), labelled_sha256(&dataset, &ids)?))
        };
        let names: Vec<String> = study.config.datasets.iter().map(|d| d.name.clone()).collect();
        Ok(Found { standings, tests: names.iter().map(test).collect::<Result<_>>()? })
    }

    /// Whether a run has its detections on a test set.
    pub fn has(standing: &Standing, test_set: &str) -> bool {
        match standing {
            Standing::Done => true,
            Standing::Trained(missing) => !missing.iter().any(|name| name == test_set),
            _ => false,
        }
    }

    /// Everything that decides the results: runs with their weights or why they have none, and test sets.
    ///
    /// # Errors
    /// Weights that cannot be read.
    pub fn key(&self, study: &Study) -> Result<String> {
        let mut key = String::new();
        for (run, standing) in &self.standings {
            let weights = match standing {
                Standing::Done | Standing::Trained(_) => weights_sha256(&run.folder(&study.folder))?,
                _ => String::new(),
            };
            let _ = writeln!(key, "{run} {standing:?} {weights}");
        }
        for (name, hash) in &self.tests {
            let _ = writeln!(key, "{name} {hash}");
        }
        Ok(key)
    }
}

/// The matrix of a study, kept in `matrix.json`.
///
/// # Errors
/// Labels that cannot be read.
pub fn matrix(study: &Study, found: &Found) -> Result<Matrix> {
    let options = &study.config.evaluation.matrix;
    let path = study.folder.join("matrix.json");
    cached(&path, &(found.key(study)?, study.config.plan(), options), || {
        let mut results: BTreeMap<(RunId, String), RunResult> = BTreeMap::new();
        for (test_set, _) in &found.tests {
            let labels = TestSet::read(&open(study, test_set)?, &study.config.splits.test)?;
            let of_run = |(run, standing): &(StudyRun, Standing)| {
                let result = if Found::has(standing, test_set) {
                    let folders = [run.detections(&study.folder, test_set), run.regions(&study.folder, test_set)];
                    scores(&labels, &folders, options).map_err(|e| e.to_string())
                } else {
                    Err(reason(standing)?)
                };
                Some(((run.id.clone(), test_set.clone()), result))
            };
            results.extend(found.standings.par_iter().filter_map(of_run).collect::<Vec<_>>());
        }
        Ok(build(&study.config.plan(), &results, options))
    })
}

/// Of the detections of a run, and of the regions of one with two stages.
fn scores(labels: &TestSet, folders: &[PathBuf; 2], options: &MatrixOptions) -> Result<RunScores, DataError> {
    let [detections, regions] = folders;
    let frames = labels.with_detections(detections)?;
    let regions = if regions.is_dir() { Some(labels.with_detections(regions)?) } else { None };
    Ok(RunScores::new(&frames, regions.as_deref(), labels.label_frame, options))
}

/// Why a run has no detections; `None`: it is only missing.
fn reason(standing: &Standing) -> Option<String> {
    match standing {
        Standing::Failed(reason) => Some(reason.clone()),
        Standing::Other(differences) => {
            Some(format!("its folder holds a run with other settings ({})", differences.join("; ")))
        }
        Standing::Stopped(step, total) => Some(format!("it was stopped at step {step} of {total}")),
        Standing::Running(step, total) => Some(format!("it is being worked on, step {step} of {total}")),
        Standing::Done | Standing::Trained(_) | Standing::Missing => None,
    }
}

/// Analyses of the first run of every network and train set: on the test set of its own data, and on the first of the study. Kept in
/// `analyses.json`.
///
/// # Errors
/// Frames that cannot be read.
pub fn analyses(study: &Study, found: &Found) -> Result<Vec<(String, RunAnalysis)>> {
    let key = (found.key(study)?, &study.config.evaluation.analysis);
    cached(&study.folder.join("analyses.json"), &key, || {
        let first = &study.config.datasets[0].name;
        let mut seen = Vec::new();
        let mut out = Vec::new();
        for (run, standing) in &found.standings {
            let of = (run.id.network.clone(), run.id.train_set.clone());
            if seen.contains(&of) || !matches!(standing, Standing::Done) {
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
                out.push((title, of_run(study, run, test_set)?));
            }
            seen.push(of);
        }
        Ok(out)
    })
}

/// The title of a network.
pub fn network_title(study: &Study, network: &str) -> String {
    let plan = study.config.plan();
    plan.networks.into_iter().find(|n| n.network.name == network).map_or(network.into(), |n| n.network.title)
}

fn of_run(study: &Study, run: &StudyRun, test_set: &str) -> Result<RunAnalysis> {
    let dataset = open(study, test_set)?;
    let labels = TestSet::read(&dataset, &study.config.splits.test)?;
    let frames = labels.with_detections(&run.detections(&study.folder, test_set))?;
    let label_frame = labels.label_frame;
    let options = AnalysisOptions { label_frame, ..study.config.evaluation.analysis.clone() };
    // Boxes in the cloud's frame; labels in the camera's are tilted against it.
    let points = match label_frame {
        data::LabelFrame::Lidar => Some(points(&dataset, &frames)?),
        data::LabelFrame::Camera => None,
    };
    Ok(analyse(&frames, points.as_deref(), &options))
}

fn points(dataset: &Dataset, frames: &[eval::EvalFrame]) -> Result<Vec<BoxPoints>> {
    let boxes = |lines: &[LabelBox]| lines.iter().map(LabelBox::lidar_box).collect::<Vec<_>>();
    let of_frame = |frame: &eval::EvalFrame| {
        let cloud = dataset.load_cloud(&frame.id)?;
        Ok(BoxPoints::count(&cloud, &boxes(&frame.labels), &boxes(&frame.detections)))
    };
    frames.par_iter().map(of_frame).collect()
}

/// Some test frames, evenly over all.
///
/// # Errors
/// A split that is not there.
pub fn some_test_frames(study: &Study, dataset: &Dataset, n: usize) -> Result<Vec<String>> {
    Ok(spread(&dataset.ids(&study.config.splits.test)?, n))
}
