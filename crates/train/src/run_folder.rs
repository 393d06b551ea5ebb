//! The folder of a run: `config.toml`, `metrics.jsonl`, `provenance.json` and `checkpoint/`. It is consistent after a
//! kill at any time.
//!
//! A checkpoint is two files, weights and moments of the optimiser. They are written atomically and never changed. Then
//! `state.json`, which names them, is replaced atomically; files that it does not name are ignored. `last.safetensors`
//! and `best.safetensors` are links to such weights. They are updated before the state, so that the weights of the
//! state's step are always available under these names. The state before it and its checkpoint are kept.

use crate::TrainError;
use crate::state_file::{
    BEST, LAST, NEXT, PREVIOUS, RunState, STATE, STATE_SCHEMA, StateFile, names, read_state_file, state_sha256,
};
use data::Presence as _;
use data::checksum::file_sha256;
use data::output::{create_folder, link, remove_unfinished_below, rename};
use data::{DataError, FolderLock, write_atomic, write_json};
use models::checkpoint::{NamedTensors, read_safetensors, write_safetensors};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Fewest checkpoints that are kept: the newest, and the one that is taken if it is damaged.
const FEWEST_KEPT: usize = 2;

/// Advice for a checkpoint that cannot be used.
const ADVICE: &str = "begin the run anew in another folder";

/// A checkpoint of a run.
#[derive(Clone, Debug, PartialEq)]
pub struct Checkpoint {
    /// The state of the run.
    pub state: RunState,
    /// The weights, under OpenPCDet's names.
    pub weights: NamedTensors,
    /// The moments of the optimiser.
    pub moments: NamedTensors,
    /// Why the newest checkpoint was not taken, if it was not.
    pub warning: Option<String>,
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
        self.checkpoints().join(LAST)
    }

    /// The weights with the best average precision on the validation split.
    pub fn best_weights(&self) -> PathBuf {
        self.checkpoints().join(BEST)
    }

    fn checkpoints(&self) -> PathBuf {
        self.path.join("checkpoint")
    }

    fn state_path(&self) -> PathBuf {
        self.checkpoints().join(STATE)
    }

    /// Writes a checkpoint; a resume continues from it once this returns. Keeps the last `keep` checkpoints, two at
    /// least, and the best one.
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
        for name in [&weights_name, &moments_name] {
            sha256.insert(name.clone(), file_sha256(&self.checkpoints().join(name))?);
        }
        let best_step = state.best.as_ref().map(|best| best.step);
        let of_best = if best_step == Some(state.step) {
            sha256.get(&weights_name).cloned()
        } else {
            let before = match read_state_file(&self.state_path()) {
                // Without the file the checksum of the best weights would be lost.
                Err(error @ TrainError::Data(DataError::Io(_))) => return Err(error),
                before => before.ok().flatten(),
            };
            before.filter(|b| b.state.best == state.best).and_then(|b| b.sha256.get(BEST).cloned())
        };
        sha256.extend(of_best.map(|sum| (BEST.to_string(), sum)));
        let file = StateFile { schema: STATE_SCHEMA.into(), state: state.clone(), sha256 };
        let next = self.checkpoints().join(NEXT);
        write_json(&next, &file)?;
        self.link_last_and_best(state)?;
        if self.state_path().may_be_file() {
            link(&self.state_path(), &self.checkpoints().join(PREVIOUS))?;
        }
        // On the disk before files of older checkpoints are removed.
        rename(&next, &self.state_path())?;
        self.remove_old(state, keep)
    }

    /// The last checkpoint. If its state or one of its files is damaged, the checkpoint before it, which then is the
    /// last one.
    ///
    /// # Errors
    /// Files that are missing or have a wrong checksum, in both checkpoints.
    pub fn load(&self) -> Result<Option<Checkpoint>, TrainError> {
        let newest = self.checkpoint(STATE);
        let previous = self.checkpoints().join(PREVIOUS);
        let checkpoint = match newest {
            Ok(None) if !previous.may_be_file() => return Ok(None),
            Ok(Some(checkpoint)) => checkpoint,
            newest => {
                let reason = newest.map_or_else(
                    |error| error.to_string(),
                    |_| format!("{}: does not exist, but a state before it does", self.state_path().display()),
                );
                let Ok(Some(mut checkpoint)) = self.checkpoint(PREVIOUS) else {
                    return Err(TrainError::folder(&self.path, format!("{reason}; {ADVICE}")));
                };
                write_atomic(&self.state_path(), &fs_err::read(previous)?)?;
                let step = checkpoint.state.step;
                checkpoint.warning =
                    Some(format!("{reason}; the run goes on from the checkpoint before it, after {step} steps"));
                checkpoint
            }
        };
        self.link_last_and_best(&checkpoint.state)?;
        Ok(Some(checkpoint))
    }

    /// The checkpoint of a state, if it is as it was written.
    fn checkpoint(&self, state: &str) -> Result<Option<Checkpoint>, TrainError> {
        let Some(file) = read_state_file(&self.checkpoints().join(state))? else { return Ok(None) };
        let [weights, moments] = names(file.state.step).map(|name| {
            let path = self.checkpoints().join(&name);
            if file.sha256.get(&name) != Some(&file_sha256(&path)?) {
                return Err(TrainError::folder(&path, "is not the file that the run wrote (its checksum differs)"));
            }
            Ok(read_safetensors(&path)?)
        });
        Ok(Some(Checkpoint { state: file.state, weights: weights?, moments: moments?, warning: None }))
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

    /// Removes all checkpoints but the last `keep` ones, two at least, up to that of the state.
    ///
    /// # Errors
    /// A file that cannot be removed.
    pub fn remove_old(&self, state: &RunState, keep: usize) -> Result<(), TrainError> {
        let keep = keep.max(FEWEST_KEPT);
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::state_file::{Best, verify_weights};
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
            data_sha256: None,
            best,
        }
    }

    fn tensors(value: f32) -> NamedTensors {
        [("w".into(), HostTensor { shape: vec![1], values: HostValues::F32(vec![value]) })].into()
    }

    fn change_a_byte(path: &Path) {
        let mut bytes = std::fs::read(path).unwrap();
        *bytes.last_mut().unwrap() ^= 1;
        std::fs::write(path, bytes).unwrap();
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
            "state.previous.json",
            "step-30.optimizer.safetensors",
            "step-30.safetensors",
            "step-40.optimizer.safetensors",
            "step-40.safetensors",
        ];
        assert_eq!(files(&folder), want);
        assert_eq!(read_safetensors(&folder.best_weights()).unwrap(), tensors(10.0));
        assert_eq!(read_safetensors(&folder.last_weights()).unwrap(), tensors(40.0));
        let loaded = folder.load().unwrap().unwrap();
        let want = Checkpoint { state: state(40, best), weights: tensors(40.0), moments: tensors(-1.0), warning: None };
        assert_eq!(loaded, want);
        for weights in [folder.best_weights(), folder.last_weights()] {
            verify_weights(&weights).unwrap();
            change_a_byte(&weights);
            assert!(verify_weights(&weights).unwrap_err().to_string().contains("was changed after the run wrote it"));
        }
        assert!(folder.load().unwrap().unwrap().warning.unwrap().contains("after 30 steps"));
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
        let loaded = folder.load().unwrap().unwrap();
        assert_eq!((loaded.state.step, loaded.weights), (10, tensors(10.0)));
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
        folder.save(&state(10, None), &tensors(10.0), &BTreeMap::new(), &tensors(1.0), 2).unwrap();
        // Simulates a kill before the state of step 10 is kept and that of step 20 takes its place.
        std::fs::create_dir(folder.checkpoints().join(PREVIOUS)).unwrap();
        assert!(folder.save(&state(20, None), &tensors(20.0), &BTreeMap::new(), &tensors(1.0), 2).is_err());
        assert_eq!(read_safetensors(&folder.last_weights()).unwrap(), tensors(20.0));
        assert_eq!(read_state_file(&folder.state_path()).unwrap().unwrap().state.step, 10);
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
        change_a_byte(&folder.checkpoints().join("step-10.safetensors"));
        assert!(message(&folder).contains("step-10.safetensors: is not the file"), "{}", message(&folder));
    }

    #[test]
    fn the_checkpoint_before_a_damaged_one_is_taken() {
        let damages: [&dyn Fn(&RunFolder); 4] = [
            &|folder| std::fs::write(folder.state_path(), "").unwrap(),
            &|folder| std::fs::remove_file(folder.state_path()).unwrap(),
            &|folder| change_a_byte(&folder.checkpoints().join("step-20.safetensors")),
            &|folder| std::fs::remove_file(folder.checkpoints().join("step-20.optimizer.safetensors")).unwrap(),
        ];
        for damage in damages {
            let dir = tempfile::tempdir().unwrap();
            let folder = RunFolder::open(dir.path()).unwrap();
            for step in [10, 20] {
                let best = Some(Best { step: 10, ap: 50.0 });
                folder.save(&state(step, best), &tensors(step as f32), &BTreeMap::new(), &tensors(1.0), 1).unwrap();
            }
            damage(&folder);
            let loaded = folder.load().unwrap().unwrap();
            assert_eq!((loaded.state.step, loaded.weights), (10, tensors(10.0)));
            assert!(loaded.warning.unwrap().contains("goes on from the checkpoint before it, after 10 steps"));
            assert_eq!(read_safetensors(&folder.last_weights()).unwrap(), tensors(10.0));
            assert_eq!(folder.load().unwrap().unwrap().warning, None);
            folder.save(&state(20, None), &tensors(20.0), &BTreeMap::new(), &tensors(1.0), 1).unwrap();
            assert_eq!(folder.load().unwrap().unwrap().weights, tensors(20.0));
        }
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
