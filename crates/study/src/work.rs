//! Executes one run of a study in this process: training and detection.

use crate::config::StudyRun;
use crate::detections::detect_all;
use crate::error::{Result, StudyError, refused};
use crate::folder::Study;
use crate::run_state::{RunLock, differences, is_of_folder, remove_failure, write_failure};
use burn::tensor::Device;
use data::Presence as _;
use data::output::remove_unfinished_below;
use models::Detector;
use models::checkpoint::read_checkpoint;
use std::path::Path;
use std::sync::atomic::AtomicBool;
use train::{RunConfig, Session, read_run_state, train, verify_weights};

/// A part of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RunPart {
    /// Training.
    Train,
    /// Detections on the test sets, and features.
    Detect,
}

impl RunPart {
    /// The value of the command line option `--parts`.
    pub fn argument(self) -> &'static str {
        match self {
            RunPart::Train => "train",
            RunPart::Detect => "detect",
        }
    }
}

/// Options for executing a run.
pub struct RunWork<'a> {
    /// The parts to execute.
    pub parts: &'a [RunPart],
    /// Opens the device.
    pub device: &'a dyn Fn() -> Result<Device, String>,
    /// Name of the device.
    pub device_name: String,
    /// Threads that load frames.
    pub workers: usize,
    /// As [`Session::stop`].
    pub stop: Option<&'static AtomicBool>,
}

/// Executes a run. `on_training` is called with the events of the training, `note` with a message for each test set. An
/// error is also written to the run folder.
///
/// # Errors
/// A run that is in use by another process or has other settings; an error of training or detection.
pub fn execute_run(
    study: &Study,
    run: &StudyRun,
    work: &RunWork<'_>,
    on_training: &mut dyn FnMut(&train::Event<'_>),
    note: &dyn Fn(&str),
) -> Result<()> {
    let folder = run.folder(&study.folder);
    let Some(_lock) = RunLock::acquire(&folder)? else {
        return Err(StudyError::InUse(run.to_string()));
    };
    remove_unfinished_below(&folder)?;
    remove_failure(&folder)?;
    let done = train_and_detect(study, run, work, on_training, note);
    if let Err(error) = &done
        && !error.is_stopped()
    {
        write_failure(&folder, &error.to_string())?;
    }
    done
}

fn train_and_detect(
    study: &Study,
    run: &StudyRun,
    work: &RunWork<'_>,
    on_training: &mut dyn FnMut(&train::Event<'_>),
    note: &dyn Fn(&str),
) -> Result<()> {
    let folder = run.folder(&study.folder);
    let other = differences(study, run)?;
    if !other.is_empty() {
        return Err(refused(format!(
            "the run folder contains a run with other settings ({}); repeat it with `--replace`",
            other.join("; ")
        )));
    }
    let (config, device) = (study.run_config(run)?, (work.device)().map_err(refused)?);
    let mut detector = None;
    if work.parts.contains(&RunPart::Train) && !is_trained(&folder)? {
        follow_data_set(&folder, &config)?;
        let session = Session {
            device: device.clone(),
            device_name: work.device_name.clone(),
            workers: work.workers,
            resume: true,
            allow_changed_data: false,
            cache: Some(study.cache_folder()),
            stop: work.stop,
        };
        detector = Some(train(&config, &folder, &session, &mut |event| on_training(&event))?.detector);
    }
    if work.parts.contains(&RunPart::Detect) {
        if !is_trained(&folder)? {
            return Err(refused("the training of this run is not finished"));
        }
        let detector = match detector {
            Some(detector) => detector,
            None => {
                let path = folder.join("checkpoint/last.safetensors");
                verify_weights(&path)?;
                let weights = read_checkpoint(&path)?;
                Detector::new(&config.detector, config.seed, &device).load_named(&weights)?
            }
        };
        detect_all(study, run, &detector, work.workers, note)?;
    }
    Ok(())
}

/// Whether the training in a run folder is finished. Its configuration is known to be that of the study.
fn is_trained(folder: &Path) -> Result<bool> {
    match read_run_state(folder)? {
        Some(state) if state.step == state.total_steps && state.total_steps > 0 => is_of_folder(&state, folder),
        _ => Ok(false),
    }
}

/// Writes the present path of the data set to `config.toml` of a run that is to be continued.
fn follow_data_set(folder: &Path, config: &RunConfig) -> Result<()> {
    let path = folder.join("config.toml");
    if path.may_be_file() && RunConfig::read(&path)?.dataset != config.dataset {
        data::write_atomic(&path, config.to_toml().as_bytes())?;
    }
    Ok(())
}
