//! The folder of a run: `config.toml`, `metrics.jsonl`, `provenance.json` and `checkpoint/`. It is consistent after a
//! kill at any time.
//!
//! A checkpoint is two files, weights and moments of the optimiser. They are written atomically and never changed. Then
//! `state.json`, which names them, is replaced atomically; files that it does not name are ignored. `last.safetensors`
//! and `best.safetensors` are links to such weights. They are updated before the state, so that the weights of the
//! state's step are always available under these names.

use crate::TrainError;
use crate::run_config::hex;
use data::output::{create_folder, remove_unfinished_below};
use data::{FolderLock, write_atomic, write_json};
use models::checkpoint::{NamedTensors, read_safetensors, write_safetensors};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Version of `state.json`.
pub const STATE_SCHEMA: &str = "lidarshift/run-state/1";

/// The state of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
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
    /// The best checkpoint so far.
    pub best: Option<Best>,
}

/// An evaluated checkpoint.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Best {
    /// The step after which it was written.
    pub step: u64,
    /// Average precision on the validation split, percent.
    pub ap: f64,
}

/// The content of `state.json`.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct StateFile {
    schema: String,
    state: RunState,
    /// SHA-256 of the files of the checkpoint by name, and of the state itself under `state`.
    sha256: BTreeMap<String, String>,
}

/// A run folder, locked against other processes while this value lives.
pub struct RunFolder {
    path: PathBuf,
    _lock: FolderLock,
}

impl RunFolder {
    /// Opens or creates the folder and removes incomplete files of a killed process.
    ///
    /// # Errors
    /// A folder in use by another process, or one that cannot be written.
    pub fn open(path: &Path) -> Result<Self, TrainError> {
        let folder = RunFolder { path: path.into(), _lock: FolderLock::acquire(path)? };
        create_folder(&folder.checkpoints())?;
        remove_unfinished_below(path)?;
        Ok(folder)
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The resolved configuration.
    pub fn config_path(&self) -> PathBuf {
        self.path.join("config.toml")
    }

    /// One JSON object a line.
    pub fn metrics_path(&self) -> PathBuf {
        self.path.join("metrics.jsonl")
    }

    /// Program, data and machine of the run.
    pub fn provenance_path(&self) -> PathBuf {
        self.path.join("provenance.json")
    }

    /// The weights after the last checkpoint, under OpenPCDet's names.
    pub fn last_weights(&self) -> PathBuf {
        self.checkpoints().join("last.safetensors")
    }

    /// The weights with the best average precision on the validation split.
    pub fn best_weights(&self) -> PathBuf {
        self.checkpoints().join("best.safetensors")
    }

    fn checkpoints(&self) -> PathBuf {
        self.path.join("checkpoint")
    }

    fn state_path(&self) -> PathBuf {
        self.checkpoints().join("state.json")
    }

    /// The state of the run; `None` before its first checkpoint.
    ///
    /// # Errors
    /// A state that is damaged.
    pub fn state(&self) -> Result<Option<RunState>, TrainError> {
        Ok(self.state_file()?.map(|file| file.state))
    }

    fn state_file(&self) -> Result<Option<StateFile>, TrainError> {
        read_state_file(&self.state_path())
    }

    /// Writes a checkpoint; a resume continues from it once this returns. Keeps the last `keep` checkpoints and the
    /// best one.
    ///
    /// # Errors
    /// Files that cannot be written; the previous checkpoint then remains valid.
    pub fn save(
        &self,
        state: &RunState,
        weights: &NamedTensors,
        metadata: &BTreeMap<String, String>,
        moments: &NamedTensors,
        keep: usize,
    ) -> Result<(), TrainError> {
        let [weights_name, moments_name] = names(state.step);
        write_safetensors(&self.checkpoints().join(&weights_name), weights, metadata)?;
        write_safetensors(&self.checkpoints().join(&moments_name), moments, &BTreeMap::new())?;
        let mut sha256 = BTreeMap::from([("state".to_string(), state_sha256(state))]);
        for name in [weights_name, moments_name] {
            let bytes = fs_err::read(self.checkpoints().join(&name))?;
            sha256.insert(name, hex(&Sha256::digest(bytes)));
        }
        let file = StateFile { schema: STATE_SCHEMA.into(), state: state.clone(), sha256 };
        self.link_last_and_best(state)?;
        write_json(&self.state_path(), &file)?;
        self.remove_all_but(state, keep)
    }

    /// Weights and moments of the last checkpoint.
    ///
    /// # Errors
    /// Files that are missing or have a wrong checksum.
    pub fn load(&self) -> Result<Option<(RunState, NamedTensors, NamedTensors)>, TrainError> {
        let Some(file) = self.state_file()? else { return Ok(None) };
        let [weights, moments] = names(file.state.step).map(|name| {
            let path = self.checkpoints().join(&name);
            let bytes = fs_err::read(&path)?;
            if file.sha256.get(&name) != Some(&hex(&Sha256::digest(bytes))) {
                let message =
                    "is not the file that the run wrote (its checksum differs); begin the run anew in another folder";
                return Err(TrainError::folder(&path, message));
            }
            Ok(read_safetensors(&path)?)
        });
        self.link_last_and_best(&file.state)?;
        Ok(Some((file.state, weights?, moments?)))
    }

    /// Links `last` and `best` to the weights of the state. Repeated on loading, because they may belong to a step
    /// whose state was never written.
    fn link_last_and_best(&self, state: &RunState) -> Result<(), TrainError> {
        let weights = self.checkpoints().join(&names(state.step)[0]);
        link(&weights, &self.last_weights())?;
        if state.best.as_ref().is_some_and(|best| best.step == state.step) {
            link(&weights, &self.best_weights())?;
        }
        Ok(())
    }

    fn remove_all_but(&self, state: &RunState, keep: usize) -> Result<(), TrainError> {
        let mut steps = BTreeMap::<u64, Vec<PathBuf>>::new();
        for entry in fs_err::read_dir(self.checkpoints())? {
            let entry = entry?;
            let name = entry.file_name();
            let number = name.to_str().and_then(|n| n.strip_prefix("step-")?.split('.').next()?.parse().ok());
            if let Some(step) = number {
                steps.entry(step).or_default().push(entry.path());
            }
        }
        let kept: Vec<u64> = steps.keys().rev().copied().filter(|&step| step <= state.step).take(keep).collect();
        for (_, files) in steps.into_iter().filter(|(step, _)| !kept.contains(step)) {
            for file in files {
                fs_err::remove_file(file)?;
            }
        }
        Ok(())
    }
}

/// The state of a run without locking its folder, which another process may be using. `None` before its first
/// checkpoint.
///
/// # Errors
/// A state that is damaged.
pub fn read_run_state(folder: &Path) -> Result<Option<RunState>, TrainError> {
    Ok(read_state_file(&folder.join("checkpoint/state.json"))?.map(|file| file.state))
}

fn read_state_file(path: &Path) -> Result<Option<StateFile>, TrainError> {
    let bytes = match fs_err::read(path) {
        Ok(bytes) => bytes,
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        Err(e) => return Err(e.into()),
    };
    let damaged =
        |e: String| TrainError::folder(path, format!("is damaged ({e}); begin the run anew in another folder"));
    let file: StateFile = serde_json::from_slice(&bytes).map_err(|e| damaged(e.to_string()))?;
    if file.schema != STATE_SCHEMA {
        return Err(damaged(format!("schema is {:?}, this program writes {STATE_SCHEMA:?}", file.schema)));
    }
    let written = file.sha256.get("state");
    if ![state_sha256(&file.state), exact_sha256(&file.state)].iter().any(|sum| written == Some(sum)) {
        return Err(damaged("the checksum is wrong".into()));
    }
    Ok(Some(file))
}

fn names(step: u64) -> [String; 2] {
    [format!("step-{step}.safetensors"), format!("step-{step}.optimizer.safetensors")]
}

/// Checksum of a state with its AP rounded to six decimals, because reading JSON may change the last bit of a number.
fn state_sha256(state: &RunState) -> String {
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

/// Replaces `name` by a hard link to `file`, or by a copy if the file system has no links.
fn link(file: &Path, name: &Path) -> Result<(), TrainError> {
    let temporary = name.with_file_name(format!(".writing-link-{}", std::process::id()));
    if fs_err::hard_link(file, &temporary).is_ok() {
        fs_err::rename(&temporary, name)?;
        // Both names were the same file: POSIX defines that the rename then does nothing.
        match fs_err::remove_file(&temporary) {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => return Err(e.into()),
            _ => return Ok(()),
        }
    }
    Ok(write_atomic(name, &fs_err::read(file)?)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use models::checkpoint::{HostTensor, HostValues};

    fn state(step: u64, best: Option<Best>) -> RunState {
        RunState {
            step,
            total_steps: 100,
            epoch: 0,
            position: step as usize,
            seed: 1,
            config_sha256: "c".into(),
            frames_sha256: "f".into(),
            best,
        }
    }

    fn tensors(value: f32) -> NamedTensors {
        [("w".into(), HostTensor { shape: vec![1], values: HostValues::F32(vec![value]) })].into()
    }

    fn files(folder: &RunFolder) -> Vec<String> {
        let mut names: Vec<String> = std::fs::read_dir(folder.checkpoints())
            .unwrap()
            .map(|e| e.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        names
    }

    #[test]
    fn an_ap_that_json_changes_in_its_last_bit_is_accepted() {
        let ap = 13.406_728_366_057_271_f64;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("state.json");
        let state = state(5, Some(Best { step: 5, ap }));
        // The value that an earlier version of the parser read.
        for read in [f64::from_bits(ap.to_bits() + 1), ap] {
            let written = StateFile {
                schema: STATE_SCHEMA.into(),
                state: RunState { best: Some(Best { step: 5, ap: read }), ..state.clone() },
                sha256: [("state".into(), state_sha256(&state))].into(),
            };
            std::fs::write(&path, serde_json::to_vec(&written).unwrap()).unwrap();
            assert!(read_state_file(&path).unwrap().is_some());
        }
        let mut changed = state.clone();
        changed.best = Some(Best { step: 5, ap: ap + 0.001 });
        assert_ne!(state_sha256(&changed), state_sha256(&state));
    }

    #[test]
    fn keeps_the_best_and_the_last() {
        let dir = tempfile::tempdir().unwrap();
        let folder = RunFolder::open(dir.path()).unwrap();
        assert!(folder.load().unwrap().is_none());
        let metadata = BTreeMap::from([("detector".to_string(), "name = 1".to_string())]);
        let mut best = None;
        for step in [10, 20, 30, 40] {
            if step == 10 {
                best = Some(Best { step, ap: 50.0 });
            }
            let state = state(step, best.clone());
            folder.save(&state, &tensors(step as f32), &metadata, &tensors(-1.0), 2).unwrap();
        }
        let want = [
            "best.safetensors",
            "last.safetensors",
            "state.json",
            "step-30.optimizer.safetensors",
            "step-30.safetensors",
            "step-40.optimizer.safetensors",
            "step-40.safetensors",
        ];
        assert_eq!(files(&folder), want);
        assert_eq!(read_safetensors(&folder.best_weights()).unwrap(), tensors(10.0));
        assert_eq!(read_safetensors(&folder.last_weights()).unwrap(), tensors(40.0));
        let (loaded, weights, moments) = folder.load().unwrap().unwrap();
        assert_eq!((loaded, weights, moments), (state(40, best), tensors(40.0), tensors(-1.0)));
        assert_eq!(files(&folder), want);
    }

    #[test]
    fn files_of_a_killed_process_are_ignored() {
        let dir = tempfile::tempdir().unwrap();
        let folder = RunFolder::open(dir.path()).unwrap();
        let best = Some(Best { step: 10, ap: 50.0 });
        folder.save(&state(10, best.clone()), &tensors(10.0), &BTreeMap::new(), &tensors(1.0), 2).unwrap();
        // Killed while writing a file, between the files of the next checkpoint, and before linking.
        std::fs::write(folder.checkpoints().join(".writing-abc"), b"half").unwrap();
        std::fs::write(folder.checkpoints().join("step-20.safetensors"), b"complete, but not named").unwrap();
        std::fs::remove_file(folder.last_weights()).unwrap();
        std::fs::remove_file(folder.best_weights()).unwrap();
        drop(folder);
        let folder = RunFolder::open(dir.path()).unwrap();
        let (loaded, weights, _) = folder.load().unwrap().unwrap();
        assert_eq!((loaded.step, weights), (10, tensors(10.0)));
        assert!(folder.last_weights().is_file() && folder.best_weights().is_file());
        folder.save(&state(15, best), &tensors(15.0), &BTreeMap::new(), &tensors(1.0), 2).unwrap();
        assert!(
            !files(&folder).iter().any(|f| f.contains("step-20") || f.contains(".writing")),
            "{:?}",
            files(&folder)
        );
    }

    #[test]
    fn last_weights_are_never_older_than_the_state() {
        let dir = tempfile::tempdir().unwrap();
        let folder = RunFolder::open(dir.path()).unwrap();
        std::fs::create_dir(folder.state_path()).unwrap(); // simulates a kill when the state is written
        assert!(folder.save(&state(10, None), &tensors(10.0), &BTreeMap::new(), &tensors(1.0), 2).is_err());
        assert_eq!(read_safetensors(&folder.last_weights()).unwrap(), tensors(10.0));
    }

    #[test]
    fn damage_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let folder = RunFolder::open(dir.path()).unwrap();
        folder.save(&state(10, None), &tensors(10.0), &BTreeMap::new(), &tensors(1.0), 2).unwrap();
        let message = |folder: &RunFolder| folder.load().err().unwrap().to_string();
        let text = std::fs::read_to_string(folder.state_path()).unwrap();
        std::fs::write(folder.state_path(), text.replace("\"position\": 10", "\"position\": 11")).unwrap();
        assert!(message(&folder).contains("checksum"), "{}", message(&folder));
        std::fs::write(folder.state_path(), &text[..text.len() / 2]).unwrap();
        assert!(message(&folder).contains("state.json: is damaged"), "{}", message(&folder));
        std::fs::write(folder.state_path(), &text).unwrap();
        let weights = folder.checkpoints().join("step-10.safetensors");
        let mut bytes = std::fs::read(&weights).unwrap();
        *bytes.last_mut().unwrap() ^= 1;
        std::fs::remove_file(&weights).unwrap();
        std::fs::write(&weights, bytes).unwrap();
        assert!(message(&folder).contains("step-10.safetensors: is not the file"), "{}", message(&folder));
    }

    #[test]
    fn a_second_process_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let first = RunFolder::open(dir.path()).unwrap();
        let message = RunFolder::open(dir.path()).err().unwrap().to_string();
        assert!(message.contains("in use by another process (process "), "{message}");
        drop(first);
        RunFolder::open(dir.path()).unwrap();
    }
}
