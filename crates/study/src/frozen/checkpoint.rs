//! Detections by a checkpoint that was made elsewhere, in a process of their own, as those of a run of the study.

use super::{FrozenCell, expected_cell, is_done};
use crate::config::FrozenDetector;
use crate::data_sets::open;
use crate::detections::detect;
use crate::error::{InPart, Result, refused};
use crate::folder::Study;
use crate::local::current_program;
use crate::{Event, Listener};
use burn::tensor::Device;
use data::Presence as _;
use data::output::create_folder;
use data::write_json;
use models::checkpoint::read_checkpoint;
use models::config::DetectorConfig;
use models::{Detector, find_detector};
use sha2::{Digest, Sha256};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// The configuration of the detector of a checkpoint.
fn config(study: &Study, frozen: &FrozenDetector) -> Result<DetectorConfig> {
    let named = frozen.detector.clone().unwrap_or_default();
    let path = study.path(&named);
    let named = if path.may_be_file() { path.display().to_string() } else { named.display().to_string() };
    find_detector(&named).in_part(|| format!("frozen {}: detector", frozen.name))
}

/// Hash of the weights and of the detector, in hexadecimal.
///
/// # Errors
/// A checkpoint that cannot be read, an unknown detector.
pub(super) fn checkpoint_sha256(study: &Study, frozen: &FrozenDetector, checkpoint: &Path) -> Result<String> {
    let mut hash = Sha256::new();
    hash.update(data::checksum::file_sha256(&study.path(checkpoint))?);
    hash.update(serde_json::to_vec(&config(study, frozen)?)?);
    Ok(hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect())
}

/// Detects with a frozen checkpoint on every data set without complete detections. `note` is called with the progress.
///
/// # Errors
/// An unknown name, weights that do not fit the detector, frames that cannot be read.
pub fn detect_frozen(study: &Study, name: &str, device: &Device, workers: usize, note: &dyn Fn(&str)) -> Result<()> {
    let frozen = study.config.frozen_detector(name);
    let frozen = frozen.ok_or_else(|| refused(format!("the study has no frozen detector {name:?}")))?;
    let Some(checkpoint) = &frozen.checkpoint else {
        return Err(refused(format!("frozen {name} has no checkpoint; its detections are given")));
    };
    let (path, config) = (study.path(checkpoint), config(study, frozen)?);
    train::verify_weights(&path)?;
    let weights = read_checkpoint(&path)?;
    let detector = Detector::new(&config, 0, device)
        .load_named(&weights)
        .in_part(|| format!("{} does not fit the detector {}", path.display(), config.name))?;
    for dataset in &study.config.datasets {
        if is_done(study, frozen, &dataset.name)? {
            continue;
        }
        note(&format!("detecting on {}", dataset.name));
        let set = open(study, &dataset.name)?;
        let ids = set.ids(&study.config.splits.test)?;
        let folders = frozen.cell(study, &dataset.name);
        let files =
            detect(&detector, &set, &ids, &folders, workers).in_part(|| format!("data set {}", dataset.name))?;
        let cell = FrozenCell { files: Some(files), ..expected_cell(study, frozen, &dataset.name)? };
        write_json(&FrozenCell::path(study, frozen, &dataset.name), &cell)?;
    }
    Ok(())
}

/// Starts a process that detects with a frozen checkpoint and waits for its end. The process exits when this one ends.
///
/// # Errors
/// A process that cannot be started or that fails, with its last message.
pub(super) fn run_process(
    study: &Study,
    frozen: &FrozenDetector,
    device: &[String],
    listener: Listener<'_>,
) -> Result<()> {
    listener(Event::Note(&format!("frozen {}: detecting with its checkpoint", frozen.name)));
    let folder = frozen.folder(study);
    create_folder(&folder)?;
    let log_path: PathBuf = folder.join("log.txt");
    let log = fs_err::File::create(&log_path)?;
    let mut command = Command::new(current_program()?);
    command.arg("study-run").arg(&study.folder).args(["--attached", "--frozen", &frozen.name]).args(device);
    command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(log.into_file());
    let mut child = command.spawn().in_part(|| format!("frozen {} could not be started", frozen.name))?;
    let standard_input = child.stdin.take(); // open until the process has ended
    let status = child.wait()?;
    drop(standard_input);
    if status.success() {
        return Ok(());
    }
    let text = fs_err::read_to_string(&log_path).unwrap_or_default();
    let last = text.lines().rev().find(|line| !line.trim().is_empty()).unwrap_or("it wrote no message");
    Err(refused(format!("frozen {}: {}", frozen.name, last.strip_prefix("error: ").unwrap_or(last))))
}
