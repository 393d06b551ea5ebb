//! `lidarshift study-run`: executes one run of a study in a separate process.

use crate::device::DeviceArgs;
use crate::signals::{self, SaveFirst};
use crate::{errln, outln};
use anyhow::Result;
use clap::{Args, ValueEnum};
use data::output::TemporaryFolder;
use std::io::Read as _;
use std::path::PathBuf;
use std::time::{Duration, Instant};
use study::{RunPart, RunWork, Study, detect_frozen, execute_run, measure};
use train::Event;

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum PartArg {
    /// Training.
    Train,
    /// Detections on the test sets, and features.
    Detect,
    /// Only the time and memory of a few training steps and detections, as JSON on stdout.
    Measure,
    /// As measure, without a file in the folder of the study.
    MeasureOnly,
}

/// Execute one run of a study. `lidarshift study` or Slurm starts one such process per run.
#[derive(Args, Debug)]
pub struct StudyRunArgs {
    /// Folder of the study, or its TOML with --out
    study: String,
    /// Folder of the study, if STUDY is its TOML
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Name of the run: NETWORK/TRAIN_SET/seed-K
    #[arg(long, value_name = "NAME", required_unless_present = "frozen")]
    run: Option<String>,
    /// Instead of a run: detect with the checkpoint of this frozen detector
    #[arg(long, value_name = "NAME", conflicts_with = "run")]
    frozen: Option<String>,
    /// Parts of the run to execute
    #[arg(long, value_enum, value_delimiter = ',', default_values = ["train", "detect"])]
    parts: Vec<PartArg>,
    /// Exit when stdin is closed, that is, when the parent process has ended
    #[arg(long)]
    attached: bool,
    #[command(flatten)]
    device: DeviceArgs,
    /// Threads that load frames
    #[arg(long, default_value_t = 1, value_name = "N")]
    workers: usize,
}

impl StudyRunArgs {
    /// Executes the run. An error is also written to the run folder.
    ///
    /// # Errors
    /// As [`execute_run`].
    pub fn run(self) -> Result<()> {
        if self.attached {
            std::thread::spawn(exit_with_stdin);
        }
        let study = Study::open(&self.study, self.out.as_deref())?;
        if let Some(name) = &self.frozen {
            return Ok(detect_frozen(&study, name, &self.device.open()?, self.workers, &|note| errln!("{note}"))?);
        }
        let run = study.run(self.run.as_deref().unwrap_or_default())?;
        if let Some(part @ (PartArg::Measure | PartArg::MeasureOnly)) = self.parts.first() {
            let temporary = (*part == PartArg::MeasureOnly).then(TemporaryFolder::new).transpose()?;
            let cache = temporary.as_ref().map_or_else(|| study.cache_folder(), |t| t.path().into());
            outln!("{}", serde_json::to_string(&measure(&study, &run, &cache, &self.device.open()?)?)?);
            return Ok(());
        }
        let part = |arg: &PartArg| match arg {
            PartArg::Train => Some(RunPart::Train),
            PartArg::Detect => Some(RunPart::Detect),
            PartArg::Measure | PartArg::MeasureOnly => None,
        };
        let parts: Vec<RunPart> = self.parts.iter().filter_map(part).collect();
        let work = RunWork {
            parts: &parts,
            device: &|| self.device.open().map_err(|e| format!("{e:#}")),
            device_name: self.device.describe(),
            workers: self.workers,
            stop: signals::stop_flag(),
        };
        let mut last = Instant::now();
        let mut save_first = SaveFirst::default();
        let mut on_training = |event: &Event<'_>| {
            show(event, &mut last);
            save_first.follow(event);
        };
        execute_run(&study, &run, &work, &mut on_training, &|note| errln!("{note}"))?;
        Ok(())
    }
}

fn show(event: &Event<'_>, last: &mut Instant) {
    match event {
        Event::Begin { state, epochs, frames, .. } => {
            errln!("{frames} training frames, {epochs} epochs, step {} of {}", state.step, state.total_steps);
        }
        Event::Warning(text) => errln!("warning: {text}"),
        Event::Step { metrics, logged: true } if last.elapsed() > Duration::from_secs(10) => {
            errln!("step {}: loss {:.4}, {:.1} samples/s", metrics.step, metrics.loss, metrics.samples_per_s);
            *last = Instant::now();
        }
        Event::Step { .. } => {}
        Event::Epoch(metrics) => {
            let ap = metrics.validation.as_ref().and_then(|v| v.ap_loose);
            let ap = ap.map_or(String::new(), |ap| format!(", AP at loose overlaps {ap:.1}"));
            errln!("epoch {}: loss {:.4}{ap}", metrics.epoch + 1, metrics.train_loss);
        }
    }
}

fn exit_with_stdin() {
    let mut ignored = [0; 64];
    while std::io::stdin().read(&mut ignored).is_ok_and(|n| n > 0) {}
    signals::stop(0);
}
