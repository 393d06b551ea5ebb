//! `lidarshift train`: one training run, by default on a synthetic data set, or all runs of a study.

mod progress;
mod results;

use crate::device::DeviceArgs;
use crate::errln;
use crate::json::JsonArgs;
use crate::signals::{self, SaveFirst};
use crate::study::{SchedulingArgs, run_study};
use anyhow::{Context, Result, bail};
use clap::Args;
use data::Dataset;
use data::Presence as _;
use data::output::TemporaryFolder;
use data::toml_text::parse_toml;
use models::detector_text;
use progress::Progress;
use simulate::{FrameCounts, RoadConfig, make_road_dataset};
use std::path::{Path, PathBuf};
use study::{Step, Study};
use toml::{Table, Value};
use train::{RunConfig, Session, evaluate_detector, set_key, train};

const DEFAULT_DETECTOR: &str = "pointpillars_small";

/// Train a detector. Without --dataset, a synthetic data set is generated: roads with cars, scanned by a spinning
/// LiDAR.
///
/// A run folder contains config.toml, metrics.jsonl, provenance.json and checkpoint/. The parameters in
/// last.safetensors have OpenPCDet's names. A run that was interrupted at any moment is resumed with --resume. Its
/// final weights are bit-identical to those of an uninterrupted run.
///
/// Examples:
///   lidarshift train
///   lidarshift train --dataset my-data --detector pointpillars_small --seed 1 --out runs/mine
///   lidarshift train --dataset my-data --detector pointpillars_small --seed 1 --out runs/mine --resume
///   lidarshift train --study quick --dry-run
///   lidarshift train --dataset my-data --set optimization.lr_max=0.001 --set run.checkpoint_every_steps=100
#[derive(Args, Debug)]
#[command(verbatim_doc_comment)]
pub struct TrainArgs {
    /// Data set: folder or TOML [default: a synthetic one in runs/default/data]
    #[arg(long, value_name = "DIR|TOML")]
    dataset: Option<PathBuf>,
    /// Detector: a name of configs/detectors or a TOML [default: pointpillars_small]
    #[arg(long, value_name = "NAME|TOML")]
    detector: Option<String>,
    /// Random seed of the initial weights, the frame order and the augmentation [default: 0]
    #[arg(long, value_name = "K")]
    seed: Option<u64>,
    /// Number of epochs [default: from the detector's TOML]
    #[arg(long, value_name = "N")]
    epochs: Option<u64>,
    /// Run folder [default: runs/DETECTOR/DATASET/seed-K; runs/default/seed-K without --dataset]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten)]
    device: DeviceArgs,
    /// Override a key of the detector's TOML (optimization.lr_max=0.001) or of the run (run.log_every_steps=1); can be
    /// repeated
    #[arg(long = "set", value_name = "A.B=C")]
    set: Vec<String>,
    /// Initial weights: safetensors, or a .pth of OpenPCDet
    #[arg(long, value_name = "FILE")]
    init: Option<PathBuf>,
    /// Resume the run in --out, or start it if there is none; options that are not repeated keep their values
    #[arg(long)]
    resume: bool,
    /// Resume although the labels or clouds of the data set have changed since the last checkpoint
    #[arg(long, requires = "resume")]
    allow_changed_data: bool,
    /// Folder for the database of ground-truth sampling, which runs on the same frames may share [default: `cache` in
    /// the run folder]
    #[arg(long, value_name = "DIR")]
    cache: Option<PathBuf>,
    /// Train and evaluate on all frames without augmentation, to check that the network can fit the data; without
    /// --epochs, the number of epochs is increased to what the network needs for this
    #[arg(long)]
    overfit: bool,
    /// Threads that load and augment frames; the weights do not depend on it
    #[arg(long, default_value_t = 2, value_name = "N")]
    workers: usize,
    /// Only check that training runs: a few frames and steps in a temporary folder
    #[arg(long, conflicts_with_all = ["dataset", "resume"])]
    smoke: bool,
    /// Train all missing runs of a study instead of one run: a name (quick, cpu, gain, paper) or a TOML
    #[arg(long, value_name = "STUDY", conflicts_with_all = ["dataset", "detector", "seed", "epochs", "set", "init", "resume", "overfit", "smoke", "json"])]
    study: Option<String>,
    #[command(flatten)]
    scheduling: SchedulingArgs,
    #[command(flatten)]
    json: JsonArgs,
}

impl TrainArgs {
    /// Trains, evaluates, and prints the paths of the results.
    pub fn run(mut self) -> Result<()> {
        if let Some(study) = &self.study {
            let study = Study::open(study, self.out.as_deref())?;
            let options = self.scheduling.options(vec![Step::Data, Step::Train], &self.device);
            return run_study(&study, &options, &JsonArgs::default());
        }
        self.json.check([])?;
        let device = self.device.open()?;
        let temporary = (self.smoke && self.out.is_none()).then(TemporaryFolder::new).transpose()?;
        if let Some(folder) = &temporary {
            self.out = Some(folder.path().into());
        }
        let (config, out) = match self.stored()? {
            Some((stored, out)) => (self.changed(stored.to_table())?, out),
            None => self.fresh()?,
        };
        Dataset::without_classes(&config.dataset)?.refuse_own_folder(&out)?;
        errln!("device: {}", self.device.describe());
        // The default run is always resumed.
        let resume = self.resume || self.dataset.is_none();
        let session = Session {
            device,
            device_name: self.device.describe(),
            workers: self.workers,
            resume,
            allow_changed_data: self.allow_changed_data,
            cache: self.cache.clone(),
            stop: signals::stop_flag(),
        };
        let mut progress = Progress::default();
        let mut save_first = SaveFirst::default();
        let trained = train(&config, &out, &session, &mut |event| {
            progress.show(&event);
            save_first.follow(&event);
        });
        progress.finish();
        let trained = trained?;

        let set = Dataset::open(&config.dataset)?;
        let named = ["test", config.run.val_split.as_str()].into_iter().find(|s| set.config.splits.contains_key(*s));
        let (ids, what) = match named {
            _ if config.overfit => (set.all_ids()?, "all frames, which are also the training frames".to_string()),
            Some(split) => (set.ids(split)?, format!("the split {split}")),
            None => {
                errln!("not evaluated: the data set has neither the split test nor the split {}", config.run.val_split);
                return results::write_curve_and_list(&out, temporary.is_none());
            }
        };
        let counter = progress::bar("{bar:30} {pos}/{len} frames evaluated, {eta} left", ids.len())?;
        let mut count = |done| counter.set_position(done as u64);
        let found = evaluate_detector(&trained.detector, &set, &ids, self.workers, &mut count)?;
        counter.finish_and_clear();
        results::write(&found, &set, &out)?;
        self.json.write(&found.report)?;
        results::show(&found, &what);
        results::write_curve_and_list(&out, temporary.is_none())
    }

    /// Configuration and folder of the run to resume, if there is one.
    fn stored(&self) -> Result<Option<(RunConfig, PathBuf)>> {
        let Some(out) = self.out.as_ref().filter(|_| self.resume) else { return Ok(None) };
        let path = out.join("config.toml");
        Ok(if path.may_be_file() { Some((RunConfig::read(&path)?, out.clone())) } else { None })
    }

    /// Configuration and folder of a new run.
    fn fresh(&self) -> Result<(RunConfig, PathBuf)> {
        let mut table = Table::new();
        table.insert("seed".into(), Value::Integer(0));
        table.insert("detector".into(), Value::Table(detector_table(DEFAULT_DETECTOR)?));
        let home = self.out.clone().unwrap_or_else(|| "runs/default".into());
        if self.dataset.is_none() {
            table.insert("dataset".into(), path_value(&make_data(&home.join("data"), self.smoke)?)?);
        }
        if self.smoke {
            set_key(&mut table, "optimization.epochs=1")?;
        }
        let mut config = self.changed(table)?;
        if config.overfit && self.epochs.is_none() && !self.set.iter().any(|s| s.contains("optimization.epochs")) {
            let frames = Dataset::without_classes(&config.dataset)?.all_ids()?.len();
            let least = config.detector.network.overfit_steps();
            let optimization = &mut config.detector.optimization;
            // Evaluation uses running statistics, which differ from the batch statistics of a single frame.
            optimization.batch_size = optimization.batch_size.max(2);
            let steps = frames.div_ceil(optimization.batch_size);
            optimization.epochs = least.div_ceil(steps).max(optimization.epochs);
            config.run.evaluate_every_epochs = (optimization.epochs / 10).max(1) as u64;
        }
        let seed = format!("seed-{}", config.seed);
        let out = match (&self.out, &self.dataset) {
            (Some(out), Some(_)) => out.clone(),
            (_, None) => home.join(seed),
            (None, Some(dataset)) => {
                let mut name = Dataset::without_classes(dataset)?.config.name;
                if config.overfit {
                    name += "-overfit";
                }
                Path::new("runs").join(&config.detector.name).join(name).join(seed)
            }
        };
        Ok((config, out))
    }

    /// Parses a run's table after the command line options have been merged into it.
    fn changed(&self, mut table: Table) -> Result<RunConfig> {
        if let Some(seed) = self.seed {
            table.insert("seed".into(), Value::Integer(i64::try_from(seed).context("--seed is too large")?));
        }
        if let Some(dataset) = &self.dataset {
            Dataset::without_classes(dataset)?;
            table.insert("dataset".into(), path_value(dataset)?);
        }
        if let Some(init) = &self.init {
            table.insert("init".into(), path_value(init)?);
        }
        if self.overfit {
            table.insert("overfit".into(), Value::Boolean(true));
        }
        if let Some(detector) = &self.detector {
            table.insert("detector".into(), Value::Table(detector_table(detector)?));
        }
        if let Some(epochs) = self.epochs {
            set_key(&mut table, &format!("optimization.epochs={epochs}"))?;
        }
        for assignment in &self.set {
            set_key(&mut table, assignment)?;
        }
        RunConfig::from_table(table)
            .with_context(|| format!("detector {}", self.detector.as_deref().unwrap_or(DEFAULT_DETECTOR)))
    }
}

fn detector_table(name_or_path: &str) -> Result<Table> {
    Ok(parse_toml(&detector_text(name_or_path)?, Path::new(name_or_path), |_| Ok(()))?)
}

/// The absolute path, so that a run can be resumed from any working directory.
fn path_value(path: &Path) -> Result<Value> {
    let absolute = if data::is_url(path) { path.to_path_buf() } else { fs_err::canonicalize(path)? };
    match absolute.to_str() {
        Some(text) => Ok(Value::String(text.into())),
        None => bail!("{}: the path is not UTF-8 and cannot be written to a TOML", path.display()),
    }
}

/// Generates the synthetic data set of the default run; existing frames are kept.
fn make_data(folder: &Path, smoke: bool) -> Result<PathBuf> {
    let mut road = RoadConfig::default();
    if smoke {
        road.frames = FrameCounts { train: 4, val: 1, test: 2 };
    }
    let bar = progress::bar("{bar:30} {pos}/{len} frames generated, {eta} left", road.frames.total())?;
    make_road_dataset(&road, folder, &|done, _| bar.set_position(done as u64))?;
    bar.finish_and_clear();
    errln!("data set: {}", folder.display());
    Ok(folder.into())
}
