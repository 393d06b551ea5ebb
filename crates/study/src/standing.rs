//! How the runs of a study stand, from their folders alone.

use crate::config::StudyRun;
use crate::error::Result;
use crate::folder::Study;
use data::write_json;
use serde::{Deserialize, Serialize};
use std::fs::{File, TryLockError};
use std::path::Path;
use std::time::Duration;
use train::{RunConfig, read_run_state};

/// How a run stands.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Standing {
    /// Trained, and its detections are there.
    Done,
    /// Trained; its detections on these test sets are missing.
    Trained(Vec<String>),
    /// A process is working on it: steps done, steps of the whole.
    Running(u64, u64),
    /// It was stopped on the way: steps done, steps of the whole.
    Stopped(u64, u64),
    /// It ended with an error.
    Failed(String),
    /// Its folder holds a run with other settings.
    Other(Vec<String>),
    /// Nothing is there.
    Missing,
}

/// What a failed run leaves.
#[derive(Serialize, Deserialize)]
struct Failure {
    schema: String,
    reason: String,
}

const FAILURE: &str = "failed.json";

/// Says that a run has failed.
pub fn write_failure(folder: &Path, reason: &str) -> Result<()> {
    let failure = Failure { schema: "lidarshift/failed-run/1".into(), reason: reason.into() };
    Ok(write_json(&folder.join(FAILURE), &failure)?)
}

/// Forgets a failure: the run is tried again.
pub fn forget_failure(folder: &Path) -> Result<()> {
    match fs_err::remove_file(folder.join(FAILURE)) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(e.into()),
        _ => Ok(()),
    }
}

/// Why a run failed, if it did.
pub fn read_failure(folder: &Path) -> Option<String> {
    let bytes = fs_err::read(folder.join(FAILURE)).ok()?;
    Some(serde_json::from_slice(&bytes).map_or_else(|e| format!("{FAILURE} is damaged: {e}"), |f: Failure| f.reason))
}

/// Held by the process that works on a run.
pub struct AtWork(File);

impl AtWork {
    /// Takes the run; `None` when another process has it.
    pub fn take(folder: &Path) -> Result<Option<AtWork>> {
        fs_err::create_dir_all(folder)?;
        let path = folder.join(".working");
        let file = fs_err::OpenOptions::new().write(true).create(true).truncate(false).open(path)?.into_file();
        // Who only looks whether it is taken holds it for a moment.
        for _ in 0..20 {
            match file.try_lock() {
                Ok(()) => return Ok(Some(AtWork(file))),
                Err(TryLockError::WouldBlock) => std::thread::sleep(Duration::from_millis(10)),
                Err(TryLockError::Error(e)) => return Err(e.into()),
            }
        }
        Ok(None)
    }

    /// Whether a process works on the run in a folder.
    pub fn is_taken(folder: &Path) -> bool {
        let Ok(file) = File::options().write(true).open(folder.join(".working")) else { return false };
        matches!(file.try_lock_shared(), Err(TryLockError::WouldBlock))
    }
}

impl Drop for AtWork {
    fn drop(&mut self) {
        // Closing the file does the same; nothing depends on the answer.
        self.0.unlock().ok();
    }
}

/// The settings in which the run in a folder differs from those of the study; empty without a run.
pub fn differences(study: &Study, run: &StudyRun) -> Result<Vec<String>> {
    let path = run.folder(&study.folder).join("config.toml");
    if !path.is_file() {
        return Ok(Vec::new());
    }
    Ok(match RunConfig::read(&path) {
        Ok(found) => found.differences(&study.run_config(run)?),
        Err(e) => vec![e.to_string()],
    })
}

/// How a run stands.
pub fn standing(study: &Study, run: &StudyRun) -> Result<Standing> {
    let folder = run.folder(&study.folder);
    if !folder.is_dir() {
        return Ok(Standing::Missing);
    }
    let other = differences(study, run)?;
    if !other.is_empty() {
        return Ok(Standing::Other(other));
    }
    let state = match read_run_state(&folder) {
        Ok(state) => state,
        Err(e) => return Ok(Standing::Failed(e.to_string())),
    };
    let (step, total) = state.as_ref().map_or((0, 0), |s| (s.step, s.total_steps));
    if AtWork::is_taken(&folder) {
        return Ok(Standing::Running(step, total));
    }
    if let Some(reason) = read_failure(&folder) {
        return Ok(Standing::Failed(reason));
    }
    let Some(state) = state else { return Ok(Standing::Missing) };
    if state.config_sha256 != study.run_config(run)?.sha256() {
        let reason = "its checkpoint belongs to another configuration than the run folder's config.toml says";
        return Ok(Standing::Failed(reason.into()));
    }
    if step < total {
        return Ok(Standing::Stopped(step, total));
    }
    let weights = crate::detections::weights_sha256(&folder)?;
    let mut missing = Vec::new();
    for dataset in &study.config.datasets {
        if !crate::detections::is_done(study, run, &dataset.name, &weights)? {
            missing.push(dataset.name.clone());
        }
    }
    Ok(if missing.is_empty() { Standing::Done } else { Standing::Trained(missing) })
}
