//! `lidarshift study-run`: one run of a study in a process of its own, from its first step to its detections.

use super::cost::measure;
use super::detections::detect_all;
use super::folder::Study;
use super::standing::{AtWork, differences, forget_failure, write_failure};
use crate::device::DeviceArgs;
use anyhow::{Result, bail};
use clap::{Args, ValueEnum};
use eval::study::StudyRun;
use models::Detector;
use models::checkpoint::read_checkpoint;
use std::io::Read as _;
use std::path::Path;
use std::time::{Duration, Instant};
use train::{Event, RunConfig, Session, read_run_state, train};

/// What is done of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum RunPart {
    /// Training.
    Train,
    /// Detections and features of the test sets.
    Detect,
    /// Nothing but a few steps and detections, to see what they cost: JSON on stdout.
    Measure,
}

/// One run of a study; the study itself, or a cluster, starts as many of these as there are runs.
#[derive(Args, Debug)]
pub struct StudyRunArgs {
    /// Folder of the study
    study: String,
    /// The run: NETWORK/TRAIN SET/seed-K
    #[arg(long, value_name = "NAME")]
    run: String,
    /// What to do
    #[arg(long, value_enum, value_delimiter = ',', default_values = ["train", "detect"])]
    parts: Vec<RunPart>,
    /// End when stdin ends: who started this is gone then
    #[arg(long)]
    attached: bool,
    #[command(flatten)]
    device: DeviceArgs,
    /// Threads that load frames
    #[arg(long, default_value_t = 1, value_name = "N")]
    workers: usize,
}

impl StudyRunArgs {
    /// Does it; what goes wrong is left in the run's folder, too.
    pub fn run(self) -> Result<()> {
        if self.attached {
            std::thread::spawn(end_with_stdin);
        }
        let study = Study::open(&self.study, None)?;
        let run = study.run(&self.run)?;
        if self.parts.contains(&RunPart::Measure) {
            return measure(&study, &run, &self.device.open()?);
        }
        let folder = run.folder(&study.folder);
        let Some(_at_work) = AtWork::take(&folder)? else {
            bail!("another process is working on {run}; wait for it");
        };
        forget_failure(&folder)?;
        let done = self.work(&study, &run);
        if let Err(error) = &done {
            write_failure(&folder, &format!("{error:#}"))?;
        }
        done
    }

    fn work(&self, study: &Study, run: &StudyRun) -> Result<()> {
        let folder = run.folder(&study.folder);
        let other = differences(study, run)?;
        if !other.is_empty() {
            bail!("its folder holds a run with other settings ({}); `--replace` makes it anew", other.join("; "));
        }
        let (config, device) = (study.run_config(run)?, self.device.open()?);
        let mut detector = None;
        if self.parts.contains(&RunPart::Train) && !is_trained(&folder, &config)? {
            let session = Session {
                device: device.clone(),
                device_name: self.device.describe(),
                workers: self.workers,
                resume: true,
            };
            let mut last = Instant::now();
            detector = Some(train(&config, &folder, &session, &mut |event| show(&event, &mut last))?.detector);
        }
        if self.parts.contains(&RunPart::Detect) {
            if !is_trained(&folder, &config)? {
                bail!("it is not trained to its end; train it first");
            }
            let detector = match detector {
                Some(detector) => detector,
                None => {
                    let weights = read_checkpoint(&folder.join("checkpoint/last.safetensors"))?;
                    Detector::new(&config.detector, config.seed, &device).load_named(&weights)?
                }
            };
            detect_all(study, run, &detector, self.workers, &|what| eprintln!("{what}"))?;
        }
        Ok(())
    }
}

/// Whether the run in a folder has come to its end, with this configuration.
fn is_trained(folder: &Path, config: &RunConfig) -> Result<bool> {
    let state = read_run_state(folder)?;
    Ok(state.is_some_and(|s| s.step == s.total_steps && s.total_steps > 0 && s.config_sha256 == config.sha256()))
}

fn show(event: &Event<'_>, last: &mut Instant) {
    match event {
        Event::Begin { state, epochs, frames, .. } => {
            eprintln!("{frames} frames, {epochs} epochs, step {} of {}", state.step, state.total_steps);
        }
        Event::Step { metrics, logged: true } if last.elapsed() > Duration::from_secs(10) => {
            eprintln!("step {}: loss {:.4}, {:.1} samples/s", metrics.step, metrics.loss, metrics.samples_per_s);
            *last = Instant::now();
        }
        Event::Step { .. } => {}
        Event::Epoch(metrics) => {
            let ap = metrics.validation.as_ref().and_then(|v| v.ap_loose);
            let ap = ap.map_or(String::new(), |ap| format!(", AP at loose overlaps {ap:.1}"));
            eprintln!("epoch {}: loss {:.4}{ap}", metrics.epoch + 1, metrics.train_loss);
        }
    }
}

fn end_with_stdin() {
    let mut nothing = [0; 64];
    while std::io::stdin().read(&mut nothing).is_ok_and(|n| n > 0) {}
    std::process::exit(1);
}
