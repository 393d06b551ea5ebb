//! One run of a study in this process, from its first step to its detections.

use crate::config::StudyRun;
use crate::detections::detect_all;
use crate::error::{Result, refused};
use crate::folder::Study;
use crate::standing::{AtWork, differences, forget_failure, write_failure};
use burn::tensor::Device;
use models::Detector;
use models::checkpoint::read_checkpoint;
use std::path::Path;
use train::{RunConfig, Session, read_run_state, train};

/// What is done of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RunPart {
    /// Training.
    Train,
    /// Detections and features of the test sets.
    Detect,
}

impl RunPart {
    /// As the command line takes it.
    pub fn word(self) -> &'static str {
        match self {
            RunPart::Train => "train",
            RunPart::Detect => "detect",
        }
    }
}

/// How a run is worked on.
pub struct RunWork<'a> {
    /// What is done of it.
    pub parts: &'a [RunPart],
    /// Opens the device that computes, or says why that cannot be.
    pub device: &'a dyn Fn() -> Result<Device, String>,
    /// The device in words.
    pub device_name: String,
    /// Threads that load frames.
    pub workers: usize,
}

/// Does it. `on_training` hears of the training, `note` a sentence for each test set. What goes wrong is left in the run's folder, too.
///
/// # Errors
/// A run that another process works on or that was made with other settings; what cannot be trained or detected.
pub fn work_on_run(
    study: &Study,
    run: &StudyRun,
    work: &RunWork<'_>,
    on_training: &mut dyn FnMut(&train::Event<'_>),
    note: &dyn Fn(&str),
) -> Result<()> {
    let folder = run.folder(&study.folder);
    let Some(_at_work) = AtWork::take(&folder)? else {
        return Err(refused(format!("another process is working on {run}; wait for it")));
    };
    forget_failure(&folder)?;
    let done = train_and_detect(study, run, work, on_training, note);
    if let Err(error) = &done {
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
            "its folder holds a run with other settings ({}); `--replace` makes it anew",
            other.join("; ")
        )));
    }
    let (config, device) = (study.run_config(run)?, (work.device)().map_err(refused)?);
    let mut detector = None;
    if work.parts.contains(&RunPart::Train) && !is_trained(&folder, &config)? {
        let session = Session {
            device: device.clone(),
            device_name: work.device_name.clone(),
            workers: work.workers,
            resume: true,
        };
        detector = Some(train(&config, &folder, &session, &mut |event| on_training(&event))?.detector);
    }
    if work.parts.contains(&RunPart::Detect) {
        if !is_trained(&folder, &config)? {
            return Err(refused("it is not trained to its end; train it first"));
        }
        let detector = match detector {
            Some(detector) => detector,
            None => {
                let weights = read_checkpoint(&folder.join("checkpoint/last.safetensors"))?;
                Detector::new(&config.detector, config.seed, &device).load_named(&weights)?
            }
        };
        detect_all(study, run, &detector, work.workers, note)?;
    }
    Ok(())
}

/// Whether the run in a folder has come to its end, with this configuration.
fn is_trained(folder: &Path, config: &RunConfig) -> Result<bool> {
    let state = read_run_state(folder)?;
    Ok(state.is_some_and(|s| s.step == s.total_steps && s.total_steps > 0 && s.config_sha256 == config.sha256()))
}
