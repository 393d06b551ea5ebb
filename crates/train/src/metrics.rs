//! `metrics.jsonl`: one JSON object a line, `kind` "step" or "epoch".

use crate::TrainError;
use data::write_atomic;
use schemars::JsonSchema;
use serde::Serialize;
use std::collections::BTreeMap;
use std::io::Write as _;
use std::path::Path;

/// Metrics of the steps since the previous line.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct StepMetrics {
    /// Steps done.
    pub step: u64,
    /// The epoch of the last of these steps, from 0.
    pub epoch: u64,
    /// Total loss of the last step.
    pub loss: f64,
    /// The terms of the total loss.
    pub losses: BTreeMap<String, f64>,
    /// Learning rate of the last step.
    pub lr: f64,
    /// Adam's beta1 in the last step.
    pub beta1: f64,
    /// Norm of the last step's gradients before clipping.
    pub gradient_norm: f64,
    /// Frames a second.
    pub samples_per_s: f64,
    /// Share of the time that was spent waiting for data.
    pub data_wait_share: f64,
}

/// Metrics of an epoch.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct EpochMetrics {
    /// Steps done.
    pub step: u64,
    /// The epoch, from 0.
    pub epoch: u64,
    /// Mean of the total loss over those steps of the epoch that ran in this process.
    pub train_loss: f64,
    /// Time of those steps by stage.
    pub seconds: StageSeconds,
    /// Evaluation on the validation split, if one was due.
    pub validation: Option<ValidationMetrics>,
}

/// Time by stage, s.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, JsonSchema)]
pub struct StageSeconds {
    /// Waiting for frames to be loaded and augmented.
    pub data_wait: f64,
    /// Network and losses.
    pub forward: f64,
    /// Gradients, with their norm.
    pub backward: f64,
    /// The step of the optimiser.
    pub optimizer: f64,
    /// Writing checkpoints.
    pub checkpoint: f64,
}

/// An evaluation during training.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct ValidationMetrics {
    /// Mean loss over the batches, with the running statistics.
    pub loss: f64,
    /// 3D average precision (exact area under the curve, no difficulty filter, KITTI's official overlaps), mean over
    /// the classes that occur; percent.
    pub ap: Option<f64>,
    /// The same at the lower overlaps that OpenPCDet reports.
    pub ap_loose: Option<f64>,
    /// `ap` of each class; `null` for one that does not occur.
    pub ap_of_class: BTreeMap<String, Option<f64>>,
    /// Duration, s.
    pub seconds: f64,
}

#[derive(Serialize, JsonSchema)]
#[serde(tag = "kind", rename_all = "lowercase")]
pub(crate) enum Line<'a> {
    Step(&'a StepMetrics),
    Epoch(&'a EpochMetrics),
}

/// Appends lines to `metrics.jsonl`.
pub(crate) struct MetricsFile {
    file: fs_err::File,
}

impl MetricsFile {
    /// Opens the file and removes all lines after `step`: a resumed run writes them again.
    pub fn open(path: &Path, step: u64) -> Result<Self, TrainError> {
        truncate_after(path, step)?;
        Ok(MetricsFile { file: fs_err::OpenOptions::new().create(true).append(true).open(path)? })
    }

    pub fn step(&mut self, metrics: &StepMetrics) -> Result<(), TrainError> {
        self.append(&Line::Step(metrics))
    }

    pub fn epoch(&mut self, metrics: &EpochMetrics) -> Result<(), TrainError> {
        self.append(&Line::Epoch(metrics))
    }

    fn append(&mut self, line: &Line) -> Result<(), TrainError> {
        let mut text = serde_json::to_string(line).expect("metrics are plain JSON");
        text.push('\n');
        Ok(self.file.write_all(text.as_bytes())?)
    }
}

fn truncate_after(path: &Path, step: u64) -> Result<(), TrainError> {
    let bytes = match fs_err::read(path) {
        Ok(bytes) => bytes,
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(()),
        Err(e) => return Err(e.into()),
    };
    let mut kept = Vec::new();
    // An incomplete last line is from a process that was killed while writing.
    for (i, line) in bytes.split_inclusive(|b| *b == b'\n').filter(|line| line.ends_with(b"\n")).enumerate() {
        let parsed: Option<serde_json::Value> = serde_json::from_slice(line).ok();
        let Some(at) = parsed.as_ref().and_then(|v| v.get("step")?.as_u64()) else {
            let message = format!("line {} is not a line of metrics; remove it", i + 1);
            return Err(TrainError::folder(path, message));
        };
        if at <= step {
            kept.extend_from_slice(line);
        }
    }
    if kept.len() != bytes.len() {
        write_atomic(path, &kept)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn metrics(step: u64) -> StepMetrics {
        StepMetrics {
            step,
            epoch: 0,
            loss: 1.5,
            losses: [("rpn_loss_cls".into(), 1.5)].into(),
            lr: 0.001,
            beta1: 0.9,
            gradient_norm: 3.0,
            samples_per_s: 2.0,
            data_wait_share: 0.0,
        }
    }

    #[test]
    fn a_resumed_run_continues_after_its_checkpoint() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("metrics.jsonl");
        let mut file = MetricsFile::open(&path, 0).unwrap();
        (1..=5).for_each(|step| file.step(&metrics(step)).unwrap());
        let torn = [std::fs::read(&path).unwrap(), b"{\"kind\":\"st".to_vec()].concat();
        std::fs::write(&path, torn).unwrap();
        let mut file = MetricsFile::open(&path, 3).unwrap();
        file.step(&metrics(4)).unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        let steps: Vec<u64> = text
            .lines()
            .map(|line| serde_json::from_str::<serde_json::Value>(line).unwrap()["step"].as_u64().unwrap())
            .collect();
        assert_eq!(steps, [1, 2, 3, 4]);
    }

    #[test]
    fn a_damaged_line_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("metrics.jsonl");
        std::fs::write(&path, "{\"step\": 1}\nnonsense\n{\"step\": 2}\n").unwrap();
        let message = MetricsFile::open(&path, 2).err().unwrap().to_string();
        assert!(message.contains("metrics.jsonl: line 2"), "{message}");
    }
}
