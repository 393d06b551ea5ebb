//! State and remaining computing time of the runs of a study.

use crate::config::StudyRun;
use crate::cost::{known_costs, remaining};
use crate::error::Result;
use crate::folder::Study;
use crate::frozen::FrozenState;
use crate::run_state::{RunState, run_state};
use schemars::JsonSchema;
use serde::Serialize;
use std::path::PathBuf;

/// State and remaining computing time of a run.
#[derive(Clone, Debug, PartialEq)]
pub struct RunStatus {
    /// The run.
    pub run: StudyRun,
    /// Its state.
    pub run_state: RunState,
    /// Remaining computing time in s, if it is known.
    pub remaining_s: Option<f64>,
}

/// The status of all runs of a study, in the order of the study.
///
/// # Errors
/// An invalid configuration of a run.
pub fn status(study: &Study) -> Result<Vec<RunStatus>> {
    let costs = known_costs(study);
    let of_run = |run: StudyRun| {
        let run_state = run_state(study, &run)?;
        // Unknown as long as, for example, the data sets do not exist.
        let remaining_s = match &run_state {
            RunState::Done => Some(0.0),
            _ => remaining(study, &run, &costs).ok().and_then(|remaining| remaining.seconds),
        };
        Ok(RunStatus { run, run_state, remaining_s })
    };
    study.config.runs().into_iter().map(of_run).collect()
}

/// Version of [`StatusReport`].
pub const STATUS_SCHEMA: &str = "lidarshift/study-status/1";

/// The status of a study, as `study status --json` writes it.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct StatusReport {
    /// [`STATUS_SCHEMA`].
    pub schema: String,
    /// Name of the study.
    pub study: String,
    /// Its folder.
    pub folder: PathBuf,
    /// Names of its data sets, on each of which each run is tested.
    pub datasets: Vec<String>,
    /// Its runs, in their order.
    pub runs: Vec<RunReport>,
    /// Its frozen detectors, by data set.
    pub frozen: Vec<FrozenReport>,
}

/// The status of a run.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct RunReport {
    /// Its folder, relative to that of the study.
    pub run: String,
    /// Its state.
    pub state: RunStateName,
    /// Finished steps of a run that is running or stopped.
    pub step: Option<u64>,
    /// All steps of such a run.
    pub total_steps: Option<u64>,
    /// Test sets on which a trained run is not tested.
    pub untested: Vec<String>,
    /// Settings of an invalid run that differ from those of the study.
    pub differences: Vec<String>,
    /// Why a run failed.
    pub reason: Option<String>,
    /// Remaining computing time, s, if it is known.
    pub remaining_s: Option<f64>,
}

/// State of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum RunStateName {
    /// Trained and tested.
    Done,
    /// Trained, but not tested on all test sets.
    Trained,
    /// In use by a process.
    Running,
    /// Interrupted.
    Stopped,
    /// Ended with an error.
    Failed,
    /// Made with other settings.
    Invalid,
    /// Not started.
    Missing,
}

/// A frozen detector on a data set.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct FrozenReport {
    /// Its name.
    pub name: String,
    /// Name of the data set.
    pub dataset: String,
    /// Why there are no detections; null if there are.
    pub missing: Option<String>,
}

impl StatusReport {
    /// Of a study.
    pub fn new(study: &Study, runs: &[RunStatus], frozen: &FrozenState) -> Self {
        let frozen = frozen.lines().map(|(name, dataset, missing)| FrozenReport {
            name: name.into(),
            dataset: dataset.into(),
            missing: missing.map(str::to_owned),
        });
        StatusReport {
            schema: STATUS_SCHEMA.into(),
            study: study.config.name.clone(),
            folder: study.folder.clone(),
            datasets: study.config.datasets.iter().map(|dataset| dataset.name.clone()).collect(),
            runs: runs.iter().map(RunReport::new).collect(),
            frozen: frozen.collect(),
        }
    }
}

impl RunReport {
    fn new(status: &RunStatus) -> Self {
        use RunStateName as Name;
        let mut report = RunReport {
            run: status.run.to_string(),
            state: Name::Missing,
            step: None,
            total_steps: None,
            untested: Vec::new(),
            differences: Vec::new(),
            reason: None,
            remaining_s: status.remaining_s,
        };
        report.state = match &status.run_state {
            RunState::Done => Name::Done,
            RunState::Trained(tests) => {
                report.untested.clone_from(tests);
                Name::Trained
            }
            RunState::Running(step, total) | RunState::Stopped(step, total) => {
                (report.step, report.total_steps) = (Some(*step), Some(*total));
                if matches!(status.run_state, RunState::Running(..)) { Name::Running } else { Name::Stopped }
            }
            RunState::Failed(reason) => {
                report.reason = Some(reason.clone());
                Name::Failed
            }
            RunState::Other(differences) => {
                report.differences.clone_from(differences);
                Name::Invalid
            }
            RunState::Missing => Name::Missing,
        };
        report
    }
}
