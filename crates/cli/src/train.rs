//! `lidarshift train`: one run; without options on data made on the spot.

use crate::detectors::detector_text;
use crate::device::parse_device;
use anyhow::{Context, Result};
use clap::Args;
use data::{Dataset, write_atomic};
use eval::{Difficulty, Metric};
use indicatif::{ProgressBar, ProgressStyle};
use models::Detector;
use report::{BirdsEyeOptions, Style, birds_eye_png};
use simulate::{FrameCounts, RoadConfig, make_road_dataset};
use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use toml::{Table, Value};
use train::{Event, RunConfig, Session, evaluate_detector, set_key, train};

/// Train a detector. Without a data set one is made on the spot: roads with cars, seen by a spinning LiDAR.
///
/// Examples:
///   lidarshift train
///   lidarshift train --dataset my-data --detector pointpillars_small --seed 1 --out runs/mine
///   lidarshift train --dataset my-data --detector pointpillars_small --seed 1 --out runs/mine --resume
#[derive(Args, Debug)]
#[command(verbatim_doc_comment)]
pub struct TrainArgs {
    /// Folder or TOML of a data set; without it a synthetic one is made
    #[arg(long, value_name = "DIR|TOML")]
    dataset: Option<PathBuf>,
    /// Detector: a name or a TOML
    #[arg(long, default_value = "pointpillars_small", value_name = "NAME|TOML")]
    detector: String,
    /// Of the weights, the order of the frames and the augmentation
    #[arg(long, default_value_t = 0, value_name = "K")]
    seed: u64,
    /// Passes over the training set; the detector's own number without it
    #[arg(long, value_name = "N")]
    epochs: Option<u64>,
    /// Run folder
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Where the network computes: flex, ndarray, wgpu or cuda
    #[arg(long, default_value = "flex")]
    device: String,
    /// Changes a value of the run or of the detector, as optimization.lr_max=0.001; may be given more than once
    #[arg(long = "set", value_name = "A.B=C")]
    set: Vec<String>,
    /// Weights to begin with: safetensors, or OpenPCDet's .pth
    #[arg(long, value_name = "FILE")]
    init: Option<PathBuf>,
    /// Go on where a run was stopped, or begin it
    #[arg(long)]
    resume: bool,
    /// Learn and evaluate on all frames, without augmentation: shows whether the network can learn the data at all
    #[arg(long)]
    overfit: bool,
    /// Threads that load and augment frames
    #[arg(long, default_value_t = 2, value_name = "N")]
    workers: usize,
    /// A handful of frames and steps: shows that everything runs, learns nothing
    #[arg(long, conflicts_with = "dataset")]
    smoke: bool,
}

impl TrainArgs {
    /// Trains, evaluates, and says where the results lie.
    #[expect(clippy::print_stdout, reason = "results go to stdout")]
    pub fn run(self) -> Result<()> {
        let device = parse_device(&self.device)?;
        let home =
            self.out.clone().unwrap_or_else(|| PathBuf::from(if self.smoke { "runs/smoke" } else { "runs/default" }));
        let (dataset, out, resume) = match &self.dataset {
            Some(path) => (path.clone(), home, self.resume),
            // The data and the run lie side by side, and a second call goes on with both.
            None => (self.make_data(&home)?, home.join("run"), true),
        };
        let config = self.run_config(&dataset)?;
        let session = Session { device, device_name: self.device.clone(), workers: self.workers.max(1), resume };
        let mut progress = Progress::default();
        let trained = train(&config, &out, &session, &mut |event| progress.show(&event))?;
        progress.finish();
        let set = Dataset::open(&dataset)?;
        let split = if config.overfit { None } else { ["test", "val"].into_iter().find(|s| set.ids(s).is_ok()) };
        let ids = match split {
            Some(split) => set.ids(split)?,
            None => set.all_ids()?,
        };
        println!("evaluated on {} ({} frames)", split.unwrap_or("all frames"), ids.len());
        evaluate_and_draw(&trained.detector, &set, &ids, self.workers.max(1), &out)?;
        println!("run folder: {}", out.display());
        Ok(())
    }

    fn make_data(&self, home: &Path) -> Result<PathBuf> {
        let mut road = RoadConfig { seed: self.seed, ..Default::default() };
        if self.smoke {
            road.frames = FrameCounts { train: 4, val: 1, test: 2 };
        }
        let folder = home.join("data");
        let bar = bar("{bar:30} {pos}/{len} frames made, {eta} left", road.frames.total() as u64)?;
        make_road_dataset(&road, &folder, &|done, _| bar.set_position(done as u64))?;
        bar.finish_and_clear();
        eprintln!("data set in {}", folder.display());
        Ok(folder)
    }

    /// Everything merged before the one typed parse.
    fn run_config(&self, dataset: &Path) -> Result<RunConfig> {
        let detector: Table = detector_text(&self.detector)?.parse().with_context(|| self.detector.clone())?;
        let mut table = Table::new();
        table.insert("seed".into(), Value::Integer(i64::try_from(self.seed).context("--seed is too large")?));
        table.insert("dataset".into(), Value::String(dataset.to_string_lossy().into_owned()));
        table.insert("overfit".into(), Value::Boolean(self.overfit));
        if let Some(init) = &self.init {
            table.insert("init".into(), Value::String(init.to_string_lossy().into_owned()));
        }
        table.insert("detector".into(), Value::Table(detector));
        if self.smoke {
            set_key(&mut table, "optimization.epochs=1")?;
        }
        if let Some(epochs) = self.epochs {
            set_key(&mut table, &format!("optimization.epochs={epochs}"))?;
        }
        for assignment in &self.set {
            set_key(&mut table, assignment)?;
        }
        RunConfig::from_table(table).with_context(|| format!("detector {}", self.detector))
    }
}

/// AP to stdout and `eval.json`, a picture of the first frame with objects.
#[expect(clippy::print_stdout, reason = "results go to stdout")]
fn evaluate_and_draw(detector: &Detector, set: &Dataset, ids: &[String], workers: usize, out: &Path) -> Result<()> {
    let bar = bar("{bar:30} {pos}/{len} frames evaluated, {eta} left", ids.len() as u64)?;
    let evaluation = evaluate_detector(detector, set, ids, workers, &mut |done| bar.set_position(done as u64))?;
    bar.finish_and_clear();
    let path = out.join("eval.json");
    write_atomic(&path, &serde_json::to_vec_pretty(&evaluation.report)?)?;
    println!(
        "{:<12} {:>4} {:>7}  {:>7} {:>7}  {:>5} {:>5} {:>5}",
        "class", "3d", "overlap", "AP area", "AP40", "truth", "hits", "false"
    );
    for row in evaluation.report.rows.iter().filter(|r| r.metric == Metric::ThreeD && r.difficulty == Difficulty::All) {
        let percent = |ap: Option<f64>| ap.map_or("-".into(), |ap| format!("{ap:.2}"));
        let (area, ap40) = (percent(row.ap_area), percent(row.ap40));
        println!(
            "{:<12} {:>4} {:>7.2}  {area:>7} {ap40:>7}  {:>5} {:>5} {:>5}",
            row.class, "", row.overlap, row.n_gt, row.n_tp, row.n_fp
        );
    }
    println!("numbers: {}", path.display());
    for (id, detections) in ids.iter().zip(&evaluation.detections) {
        let frame = set.load(id)?;
        if frame.objects.is_empty() {
            continue;
        }
        let mut boxes: Vec<_> = frame.objects.iter().map(|o| (o.bbox, Style::GroundTruth)).collect();
        boxes.extend(detections.iter().map(|d| (d.bbox, Style::Detection { score: d.score })));
        let path = out.join(format!("{id}.png"));
        write_atomic(&path, &birds_eye_png(&frame.cloud, &boxes, &BirdsEyeOptions::default())?)?;
        println!("picture: {}", path.display());
        break;
    }
    Ok(())
}

fn bar(template: &str, length: u64) -> Result<ProgressBar> {
    Ok(ProgressBar::new(length).with_style(ProgressStyle::with_template(template)?))
}

/// A bar on a terminal, plain lines elsewhere; on stderr.
#[derive(Default)]
struct Progress {
    bar: Option<ProgressBar>,
}

impl Progress {
    fn show(&mut self, event: &Event<'_>) {
        match event {
            Event::Begin { state, epochs, frames, validation_frames } => {
                eprintln!(
                    "{frames} frames to learn from, {validation_frames} to validate, {epochs} epochs, {} steps",
                    state.total_steps
                );
                if state.step > 0 {
                    eprintln!("going on from step {}", state.step);
                }
                if std::io::stderr().is_terminal() {
                    let style = ProgressStyle::with_template("{bar:30} step {pos}/{len}, {msg}, {eta} left")
                        .expect("a fixed template");
                    self.bar = Some(ProgressBar::new(state.total_steps).with_style(style).with_position(state.step));
                }
            }
            Event::Step { metrics, logged } => {
                let message = format!("loss {:.4}, {:.1} samples/s", metrics.loss, metrics.samples_per_s);
                match &self.bar {
                    Some(bar) => {
                        bar.set_position(metrics.step);
                        bar.set_message(message);
                    }
                    None if *logged => eprintln!("step {}: {message}", metrics.step),
                    None => {}
                }
            }
            Event::Epoch(metrics) => {
                let s = &metrics.seconds;
                let mut line = format!(
                    "epoch {}: loss {:.4}; s: data wait {:.1}, forward {:.1}, backward {:.1}, optimiser {:.1}, checkpoint {:.1}",
                    metrics.epoch, metrics.train_loss, s.data_wait, s.forward, s.backward, s.optimizer, s.checkpoint
                );
                if let Some(v) = &metrics.validation {
                    let percent = |ap: Option<f64>| ap.map_or("-".into(), |ap| format!("{ap:.1}"));
                    line += &format!(
                        "; validation loss {:.4}, AP {} (loose {})",
                        v.loss,
                        percent(v.ap),
                        percent(v.ap_loose)
                    );
                }
                match &self.bar {
                    Some(bar) => bar.println(line),
                    None => eprintln!("{line}"),
                }
            }
        }
    }

    fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}
