//! `lidarshift study-run`: one run of a study in a process of its own.

use crate::device::DeviceArgs;
use anyhow::Result;
use clap::{Args, ValueEnum};
use std::io::Read as _;
use std::time::{Duration, Instant};
use study::{RunPart, RunWork, Study, measure, work_on_run};
use train::Event;

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum PartWord {
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
    parts: Vec<PartWord>,
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
    ///
    /// # Errors
    /// As [`work_on_run`].
    #[expect(clippy::print_stdout, reason = "results go to stdout")]
    pub fn run(self) -> Result<()> {
        if self.attached {
            std::thread::spawn(end_with_stdin);
        }
        let study = Study::open(&self.study, None)?;
        let run = study.run(&self.run)?;
        if self.parts.contains(&PartWord::Measure) {
            println!("{}", serde_json::to_string(&measure(&study, &run, &self.device.open()?)?)?);
            return Ok(());
        }
        let part = |word: &PartWord| match word {
            PartWord::Train => Some(RunPart::Train),
            PartWord::Detect => Some(RunPart::Detect),
            PartWord::Measure => None,
        };
        let parts: Vec<RunPart> = self.parts.iter().filter_map(part).collect();
        let work = RunWork {
            parts: &parts,
            device: &|| self.device.open().map_err(|e| format!("{e:#}")),
            device_name: self.device.describe(),
            workers: self.workers,
        };
        let mut last = Instant::now();
        work_on_run(&study, &run, &work, &mut |event| show(event, &mut last), &|what| eprintln!("{what}"))?;
        Ok(())
    }
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
