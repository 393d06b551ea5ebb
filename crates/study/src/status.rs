//! Where the runs of a study stand.

use crate::config::StudyRun;
use crate::cost::{known, left};
use crate::error::Result;
use crate::folder::Study;
use crate::standing::{Standing, standing};

/// How one run stands.
#[derive(Clone, Debug, PartialEq)]
pub struct RunStatus {
    /// The run.
    pub run: StudyRun,
    /// How it stands.
    pub standing: Standing,
    /// How long the rest of it takes, s, where that is known.
    pub left_s: Option<f64>,
}

/// All runs of a study, in its order.
///
/// # Errors
/// A study that does not make sense.
pub fn status(study: &Study) -> Result<Vec<RunStatus>> {
    let costs = known(study);
    let of_run = |run: StudyRun| {
        let standing = standing(study, &run)?;
        // What cannot be known yet, as without data sets, stays unknown.
        let left_s = match &standing {
            Standing::Done => Some(0.0),
            _ => left(study, &run, &costs).ok().and_then(|left| left.seconds),
        };
        Ok(RunStatus { run, standing, left_s })
    };
    study.config.runs().into_iter().map(of_run).collect()
}
