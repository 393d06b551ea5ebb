//! State of the runs of a study, derived from the run folders.

use crate::config::StudyRun;
use crate::error::Result;
use crate::folder::Study;
use data::Presence as _;
use data::{FolderLock, write_json};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::Path;
use train::{RunConfig, read_run_state};

/// State of a run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum RunState {
    /// Trained and tested.
    Done,
    /// Trained, but not tested on these test sets.
    Trained(Vec<String>),
    /// In use by a process: finished steps, total steps.
    Running(u64, u64),
    /// Interrupted: finished steps, total steps.
    Stopped(u64, u64),
    /// Ended with this error.
    Failed(String),
    /// The run folder contains a run with other settings; the differences.
    Other(Vec<String>),
    /// Not started.
    Missing,
}

/// Content of `failed.json` in the folder of a failed run.
#[derive(Serialize, Deserialize, JsonSchema)]
pub(crate) struct Failure {
    /// [`FAILURE_SCHEMA`].
    schema: String,
    /// Why the run failed.
    reason: String,
}

const FAILURE: &str = "failed.json";

/// Version of [`Failure`].
pub(crate) const FAILURE_SCHEMA: &str = "lidarshift/failed-run/1";

/// Writes `failed.json`.
pub fn write_failure(folder: &Path, reason: &str) -> Result<()> {
    let failure = Failure { schema: FAILURE_SCHEMA.into(), reason: reason.into() };
    Ok(write_json(&folder.join(FAILURE), &failure)?)
}

/// Removes `failed.json`, so that the run is repeated.
pub fn remove_failure(folder: &Path) -> Result<()> {
    match fs_err::remove_file(folder.join(FAILURE)) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(e.into()),
        _ => Ok(()),
    }
}

/// The error of a failed run.
pub fn read_failure(folder: &Path) -> Option<String> {
    let bytes = fs_err::read(folder.join(FAILURE)).ok()?;
    Some(serde_json::from_slice(&bytes).map_or_else(|e| format!("{FAILURE} is damaged: {e}"), |f: Failure| f.reason))
}

/// Lock on a run folder, held by the process that executes the run: its training, which also locks the folder as a
/// writer, and its detections.
pub struct RunLock(#[expect(dead_code, reason = "held until it is dropped")] FolderLock);

/// Name of the file that is locked.
const RUN_LOCK: &str = ".working";

impl RunLock {
    /// Locks a run folder; `None` if another process holds the lock.
    pub fn acquire(folder: &Path) -> Result<Option<RunLock>> {
        Ok(FolderLock::acquire_as(folder, RUN_LOCK)?.map(RunLock))
    }

    /// Whether a process holds the lock on a run folder.
    pub fn is_held(folder: &Path) -> bool {
        FolderLock::is_held(folder, RUN_LOCK)
    }
}

/// Differences between the settings in the run folder and those of the study; empty if the run has not started.
pub fn differences(study: &Study, run: &StudyRun) -> Result<Vec<String>> {
    let path = run.folder(&study.folder).join("config.toml");
    if !path.may_be_file() {
        return Ok(Vec::new());
    }
    Ok(match RunConfig::read(&path) {
        Ok(mut found) => {
            let wanted = study.run_config(run)?;
            if study.is_path_of(study.dataset(&run.id.train_set)?, &found.dataset) {
                found.dataset.clone_from(&wanted.dataset);
            }
            found.differences(&wanted)
        }
        Err(e) => vec![e.to_string()],
    })
}

/// Whether a state belongs to `config.toml` of the run folder.
pub fn is_of_folder(state: &train::RunState, folder: &Path) -> Result<bool> {
    let path = folder.join("config.toml");
    Ok(path.may_be_file() && RunConfig::read(&path)?.has_sha256(&state.config_sha256))
}

/// The state of a run.
pub fn run_state(study: &Study, run: &StudyRun) -> Result<RunState> {
    let folder = run.folder(&study.folder);
    if !folder.may_be_folder() {
        return Ok(RunState::Missing);
    }
    let other = differences(study, run)?;
    if !other.is_empty() {
        return Ok(RunState::Other(other));
    }
    let state = match read_run_state(&folder) {
        Ok(state) => state,
        Err(e) => return Ok(RunState::Failed(e.to_string())),
    };
    let (step, total) = state.as_ref().map_or((0, 0), |s| (s.step, s.total_steps));
    if RunLock::is_held(&folder) {
        return Ok(RunState::Running(step, total));
    }
    if let Some(reason) = read_failure(&folder) {
        return Ok(RunState::Failed(reason));
    }
    let Some(state) = state else { return Ok(RunState::Missing) };
    if !is_of_folder(&state, &folder)? {
        let reason = "its checkpoint belongs to another configuration than config.toml in the run folder";
        return Ok(RunState::Failed(reason.into()));
    }
    if step < total {
        return Ok(RunState::Stopped(step, total));
    }
    let weights = crate::detections::weights_sha256(&folder)?;
    let mut missing = Vec::new();
    for dataset in &study.config.datasets {
        if !crate::detections::is_done(study, run, &dataset.name, &weights)? {
            missing.push(dataset.name.clone());
        }
    }
    Ok(if missing.is_empty() { RunState::Done } else { RunState::Trained(missing) })
}
