//! State and remaining computing time of the runs of a study.

use crate::config::StudyRun;
use crate::cost::{known_costs, remaining};
use crate::error::Result;
use crate::folder::Study;
use crate::run_state::{RunState, run_state};

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
