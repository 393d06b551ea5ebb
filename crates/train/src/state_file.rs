//! `state.json` of a run folder: the state of the run and the checksums of its checkpoint.
//!
//! The state before it stands beside it as `state.previous.json`. It is taken if the newest one or its checkpoint is
//! damaged. `state.next.json` is a state whose checkpoint is written, before it becomes `state.json`.

use crate::TrainError;
use data::checksum::{file_sha256, hex};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::path::Path;

/// Version of `state.json`.
pub const STATE_SCHEMA: &str = "lidarshift/run-state/1";

/// The newest state.
pub(crate) const STATE: &str = "state.json";

/// The state before it.
pub(crate) const PREVIOUS: &str = "state.previous.json";

/// The state that is being written.
pub(crate) const NEXT: &str = "state.next.json";

/// Name of the weights of the last checkpoint.
pub(crate) const LAST: &str = "last.safetensors";

/// Name of the weights with the best average precision.
pub(crate) const BEST: &str = "best.safetensors";

/// The state of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RunState {
    /// Steps done.
    pub step: u64,
    /// Steps of the whole run.
    pub total_steps: u64,
    /// The epoch that the next step belongs to, from 0.
    pub epoch: u64,
    /// Frames of that epoch that have been processed.
    pub position: usize,
    /// The run's seed.
    pub seed: u64,
    /// [`crate::RunConfig::sha256`].
    pub config_sha256: String,
    /// SHA-256 of the ids of the training frames.
    pub frames_sha256: String,
    /// [`data::Dataset::content_sha256`] of the training and validation frames. Earlier versions have none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub data_sha256: Option<String>,
    /// The best checkpoint so far.
    pub best: Option<Best>,
}

/// An evaluated checkpoint.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Best {
    /// The step after which it was written.
    pub step: u64,
    /// Average precision on the validation split, percent.
    pub ap: f64,
}

/// The content of `state.json`.
#[derive(Clone, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct StateFile {
    pub(crate) schema: String,
    pub(crate) state: RunState,
    /// SHA-256 of the files of the checkpoint by name, of the best weights, and of the state itself under `state`.
    pub(crate) sha256: BTreeMap<String, String>,
}

impl StateFile {
    /// The checksum of a file of the folder, if this state knows it.
    fn sha256_of(&self, name: &str) -> Option<&String> {
        let [weights, _] = names(self.state.step);
        self.sha256.get(if name == LAST { weights.as_str() } else { name })
    }
}

/// What is wrong with a file of a checkpoint, without advice.
pub(crate) fn damaged(path: &Path, why: impl std::fmt::Display) -> TrainError {
    TrainError::folder(path, format!("is damaged ({why})"))
}

/// The state of a run without locking its folder, which another process may be using. `None` before its first
/// checkpoint. If the newest state is damaged, the one before it.
///
/// # Errors
/// A state that is damaged, without one before it.
pub fn read_run_state(folder: &Path) -> Result<Option<RunState>, TrainError> {
    let of = |name: &str| read_state_file(&folder.join("checkpoint").join(name));
    let newest = of(STATE).or_else(|error| match of(PREVIOUS) {
        Ok(Some(previous)) => Ok(Some(previous)),
        _ => Err(error),
    });
    Ok(newest?.map(|file| file.state))
}

/// Reads a state and checks it against its checksum; `None` without the file.
pub(crate) fn read_state_file(path: &Path) -> Result<Option<StateFile>, TrainError> {
    let bytes = match fs_err::read(path) {
        Ok(bytes) => bytes,
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        Err(e) => return Err(e.into()),
    };
    let file: StateFile = serde_json::from_slice(&bytes).map_err(|e| damaged(path, e))?;
    if file.schema != STATE_SCHEMA {
        return Err(damaged(path, format!("schema is {:?}, this program writes {STATE_SCHEMA:?}", file.schema)));
    }
    let written = file.sha256.get("state");
    if ![state_sha256(&file.state), exact_sha256(&file.state)].iter().any(|sum| written == Some(sum)) {
        return Err(damaged(path, "the checksum is wrong"));
    }
    Ok(Some(file))
}

/// Checks weights against the checksum in the state that stands beside them. Weights without a state beside them, or
/// that it does not name, are not checked.
///
/// # Errors
/// Weights that were changed after the run wrote them, or that cannot be read.
pub fn verify_weights(path: &Path) -> Result<(), TrainError> {
    let (Some(folder), Some(name)) = (path.parent(), path.file_name().and_then(|n| n.to_str())) else { return Ok(()) };
    // A killed run may have written the weights of its next state.
    let states = [STATE, PREVIOUS, NEXT].map(|state| read_state_file(&folder.join(state)).ok().flatten());
    let known: Vec<&String> = states.iter().flatten().filter_map(|state| state.sha256_of(name)).collect();
    if known.is_empty() || known.contains(&&file_sha256(path)?) {
        return Ok(());
    }
    let message = "was changed after the run wrote it (its checksum is not the one in state.json); resume the run with \
                   `lidarshift train --resume`, which writes it again, or take other weights";
    Err(TrainError::folder(path, message))
}

/// Names of weights and moments of a step.
pub(crate) fn names(step: u64) -> [String; 2] {
    [format!("step-{step}.safetensors"), format!("step-{step}.optimizer.safetensors")]
}

/// Checksum of a state with its AP rounded to six decimals, because reading JSON may change the last bit of a number.
pub(crate) fn state_sha256(state: &RunState) -> String {
    let mut state = state.clone();
    if let Some(best) = &mut state.best {
        best.ap = (best.ap * 1e6).round() / 1e6;
    }
    exact_sha256(&state)
}

/// The checksum of earlier versions.
fn exact_sha256(state: &RunState) -> String {
    hex(&Sha256::digest(serde_json::to_vec(state).expect("a state is plain JSON")))
}
