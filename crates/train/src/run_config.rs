//! The configuration of a run, `config.toml` in its folder: all that the weights depend on.

use crate::TrainError;
use data::checksum::hex;
use data::toml_text::{message_with_key, read_toml};
use models::config::DetectorConfig;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::path::{Path, PathBuf};
use toml::{Table, Value};

/// The configuration of a run. Device and number of loader threads are not part of it, because they may change when a
/// run is resumed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
    /// Seed of the initial weights, the order of the frames and the augmentation.
    pub seed: u64,
    /// Folder or TOML of the data set, absolute or relative to the working folder.
    pub dataset: PathBuf,
    /// Overfit: train and evaluate on all frames without augmentation.
    #[serde(default)]
    pub overfit: bool,
    /// Checkpoint with the initial weights.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub init: Option<PathBuf>,
    /// Intervals of logging, checkpoints and evaluation.
    #[serde(default)]
    pub run: RunOptions,
    /// The detector and its training.
    pub detector: DetectorConfig,
}

/// Splits, and intervals of logging, checkpoints and evaluation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RunOptions {
    /// Training split.
    pub train_split: String,
    /// Validation split for the best checkpoint. A data set without it is not evaluated during training.
    pub val_split: String,
    /// Steps between lines of `metrics.jsonl`.
    pub log_every_steps: u64,
    /// Steps between checkpoints. A checkpoint is also written at the end of every epoch.
    pub checkpoint_every_steps: u64,
    /// Number of checkpoints kept in addition to the best one.
    pub keep_checkpoints: usize,
    /// Epochs between evaluations; the last epoch is always evaluated. 0: never.
    pub evaluate_every_epochs: u64,
}

impl Default for RunOptions {
    fn default() -> Self {
        RunOptions {
            train_split: "train".into(),
            val_split: "val".into(),
            log_every_steps: 10,
            checkpoint_every_steps: 250,
            keep_checkpoints: 2,
            evaluate_every_epochs: 1,
        }
    }
}

impl RunConfig {
    /// Parses and checks a merged table.
    ///
    /// # Errors
    /// An unknown key, a wrong type, or values that do not fit together; the message names the key.
    pub fn from_table(table: Table) -> Result<Self, TrainError> {
        let config: RunConfig =
            table.try_into().map_err(|e: toml::de::Error| TrainError::Config(message_with_key(&e)))?;
        config.detector.check().map_err(TrainError::Config)?;
        config
            .detector
            .augmentation
            .check()
            .map_err(|message| TrainError::Config(format!("augmentation.{message}")))?;
        let run = &config.run;
        if run.log_every_steps == 0 || run.checkpoint_every_steps == 0 || run.keep_checkpoints == 0 {
            let message = "run: log_every_steps, checkpoint_every_steps and keep_checkpoints must be above 0";
            return Err(TrainError::Config(message.into()));
        }
        Ok(config)
    }

    /// Reads a run folder's `config.toml`.
    ///
    /// # Errors
    /// A file that cannot be read, or what [`RunConfig::from_table`] refuses.
    pub fn read(path: &Path) -> Result<Self, TrainError> {
        Self::from_table(read_toml(path, |_| Ok(()))?).map_err(|e| TrainError::folder(path, e.to_string()))
    }

    /// As TOML with all defaults.
    pub fn to_toml(&self) -> String {
        toml::to_string(self).expect("a run's configuration is plain TOML")
    }

    /// As a table for merging.
    pub fn to_table(&self) -> Table {
        self.to_toml().parse().expect("own TOML is valid")
    }

    /// SHA-256 of the TOML, in hexadecimal. Of the data set's path the last part counts: what is above it may be moved.
    pub fn sha256(&self) -> String {
        let dataset = self.dataset.file_name().map(PathBuf::from).unwrap_or_default();
        hex(&Sha256::digest(RunConfig { dataset, ..self.clone() }.to_toml()))
    }

    /// Whether a hash is that of this configuration, by this version or an earlier one, which included the whole path
    /// of the data set.
    pub fn has_sha256(&self, sha256: &str) -> bool {
        self.sha256() == sha256 || hex(&Sha256::digest(self.to_toml())) == sha256
    }

    /// The keys in which two runs differ, as `optimization.epochs is 10, not 20`, with the value of `self` first.
    pub fn differences(&self, other: &RunConfig) -> Vec<String> {
        let mut found = Vec::new();
        compare("", &Value::Table(self.to_table()), &Value::Table(other.to_table()), &mut found);
        found
    }
}

/// Sets `a.b=c` in a run's table before it is typed. A key whose first part is not a key of the run belongs to the
/// detector: `optimization.lr_max=0.001` is short for `detector.optimization.lr_max=0.001`. The value is parsed as
/// TOML; if it is not TOML it is a string.
///
/// # Errors
/// A text without `=`, or a key below a value that is not a table.
pub fn set_key(table: &mut Table, assignment: &str) -> Result<(), TrainError> {
    let wrong = |message: String| TrainError::Config(format!("--set {assignment}: {message}"));
    let (key, text) = assignment.split_once('=').ok_or_else(|| wrong("is not of the form a.b=c".into()))?;
    let (key, text) = (key.trim(), text.trim());
    let value = match format!("value = {text}").parse::<Table>() {
        Ok(mut parsed) if parsed.len() == 1 => parsed.remove("value").expect("its only key"),
        _ => Value::String(text.into()),
    };
    let mut parts: Vec<&str> = key.split('.').collect();
    if parts.iter().any(|part| part.is_empty()) {
        return Err(wrong("the key has an empty part".into()));
    }
    if !["seed", "dataset", "overfit", "init", "run", "detector"].contains(&parts[0]) {
        parts.insert(0, "detector");
    }
    let last = parts.pop().expect("a split text has a part");
    let mut at = table;
    for part in parts {
        let below = at.entry(part).or_insert_with(|| Value::Table(Table::new()));
        at = below.as_table_mut().ok_or_else(|| wrong(format!("{part} is a value, it has no keys")))?;
    }
    at.insert(last.into(), value);
    Ok(())
}

fn compare(path: &str, ours: &Value, theirs: &Value, found: &mut Vec<String>) {
    if let (Value::Table(ours), Value::Table(theirs)) = (ours, theirs) {
        let keys: std::collections::BTreeSet<&String> = ours.keys().chain(theirs.keys()).collect();
        for key in keys {
            let path = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
            match (ours.get(key), theirs.get(key)) {
                (Some(ours), Some(theirs)) => compare(&path, ours, theirs, found),
                (ours, _) => found.push(format!("{path} is {}set there", if ours.is_some() { "" } else { "not " })),
            }
        }
    } else if ours != theirs {
        found.push(format!("{path} is {ours}, not {theirs}"));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A small network that trains in milliseconds.
    fn tiny_table(dataset: &Path) -> Table {
        let mut table: Table = r#"
            seed = 1
            dataset = ""
            [run]
            log_every_steps = 1
            [detector]
            name = "tiny"
            classes = ["Car"]
            channels = 4
            range_m = [0.0, -5.12, -3.0, 10.24, 5.12, 1.0]
            [detector.network]
            kind = "pointpillars"
            vfe_filters = 8
            [detector.network.pillars]
            size_m = [0.32, 0.32, 4.0]
            max_points = 8
            max_train = 1000
            max_test = 1000
            [detector.network.backbone]
            layers = [0, 1]
            strides = [2, 2]
            filters = [8, 16]
            upsample_strides = [1, 2]
            upsample_filters = [8, 8]
            [[detector.network.anchors]]
            class = "Car"
            size_m = [3.9, 1.6, 1.56]
            bottom_m = -1.78
            matched = 0.6
            unmatched = 0.45
            [detector.optimization]
            epochs = 3
            batch_size = 2
        "#
        .parse()
        .unwrap();
        table["dataset"] = Value::String(dataset.to_str().unwrap().into());
        table
    }

    #[test]
    fn a_written_configuration_is_read_with_the_same_hash() {
        let config = RunConfig::from_table(tiny_table(Path::new("/data"))).unwrap();
        let again = RunConfig::from_table(config.to_table()).unwrap();
        assert_eq!((&config, config.sha256()), (&again, again.sha256()));
        assert!(config.differences(&again).is_empty());
    }

    #[test]
    fn keys_are_set_before_the_typed_parse() {
        let mut table = tiny_table(Path::new("/data"));
        let before = RunConfig::from_table(table.clone()).unwrap();
        for assignment in
            ["optimization.lr_max=0.01", "run.val_split = test", "network.pillars.size_m=[0.64, 0.64, 4.0]", "seed=7"]
        {
            set_key(&mut table, assignment).unwrap();
        }
        let after = RunConfig::from_table(table).unwrap();
        assert_eq!((after.seed, after.run.val_split.as_str(), after.detector.optimization.lr_max), (7, "test", 0.01));
        let differences = before.differences(&after);
        assert!(differences.contains(&"seed is 1, not 7".to_string()), "{differences:?}");
        assert!(
            differences.contains(&"detector.optimization.lr_max is 0.003, not 0.01".to_string()),
            "{differences:?}"
        );
        assert_eq!(differences.len(), 4);
    }

    #[test]
    fn wrong_keys_are_named() {
        for (assignment, want) in [
            ("optimization.lr_maxi=1", "lr_maxi"),
            ("optimization.lr_max=fast", "expected f64"),
            ("seed.a=1", "seed is a value"),
            ("nothing", "form a.b=c"),
            (".a=1", "empty part"),
            ("run.keep_checkpoints=0", "keep_checkpoints"),
            ("augmentation.scaling=[2.0, 1.0]", "augmentation.scaling"),
            ("optimization.epochs=0", "epochs"),
        ] {
            let mut table = tiny_table(Path::new("/data"));
            let result = set_key(&mut table, assignment).and_then(|()| RunConfig::from_table(table).map(|_| ()));
            let message = result.unwrap_err().to_string();
            assert!(message.contains(want), "{assignment}: {message}");
        }
    }
}
