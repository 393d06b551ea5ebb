//! `lidarshift train`: one run; without a data set on data made on the spot.

mod progress;
mod results;

use crate::device::DeviceArgs;
use crate::study::{HowToRun, run_study};
use anyhow::{Context, Result, bail};
use clap::Args;
use data::Dataset;
use models::config::NetworkConfig;
use models::detector_text;
use progress::Progress;
use simulate::{FrameCounts, RoadConfig, make_road_dataset};
use std::path::{Path, PathBuf};
use study::{Step, Study};
use toml::{Table, Value};
use train::{RunConfig, Session, evaluate_detector, set_key, train};

const DEFAULT_DETECTOR: &str = "pointpillars_small";
/// What a network needs at least to learn a few frames by heart, where nobody says how many epochs. The second stage of PointRCNN learns from a
/// few dozen regions a frame, and reads other points in each step.
fn overfit_steps(network: &NetworkConfig) -> usize {
    match network {
        NetworkConfig::PointPillars(_) => 400,
        NetworkConfig::PointRcnn(_) => 3600,
    }
}

/// Train a detector. Without a data set one is made on the spot: roads with cars, seen by a spinning LiDAR.
///
/// A run folder holds config.toml, metrics.jsonl, provenance.json and checkpoint/; last.safetensors in there has OpenPCDet's names.
/// A run that was stopped, whenever that was, goes on with --resume and ends with the same weights to the bit.
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
    /// Folder or TOML of a data set; without it a synthetic one is made [default: runs/default/data]
    #[arg(long, value_name = "DIR|TOML")]
    dataset: Option<PathBuf>,
    /// Detector: a name or a TOML [default: pointpillars_small]
    #[arg(long, value_name = "NAME|TOML")]
    detector: Option<String>,
    /// Of the weights, the order of the frames and the augmentation [default: 0]
    #[arg(long, value_name = "K")]
    seed: Option<u64>,
    /// Passes over the training set [default: the detector's own number]
    #[arg(long, value_name = "N")]
    epochs: Option<u64>,
    /// Run folder [default: runs/DETECTOR/DATASET/seed-K; without a data set runs/default/seed-K]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten)]
    device: DeviceArgs,
    /// Changes a key of the detector's TOML (optimization.lr_max=0.001) or of the run (run.log_every_steps=1); may be given more than once
    #[arg(long = "set", value_name = "A.B=C")]
    set: Vec<String>,
    /// Weights to begin with: safetensors, or OpenPCDet's .pth
    #[arg(long, value_name = "FILE")]
    init: Option<PathBuf>,
    /// Go on where a run was stopped, or begin it; what is not said again stays as it was
    #[arg(long)]
    resume: bool,
    /// Learn and evaluate on all frames, without augmentation: shows whether the network can learn the data at all [default: as many epochs as make 400 steps, for PointRCNN 3600]
    #[arg(long)]
    overfit: bool,
    /// Threads that load and augment frames; any number gives the same weights
    #[arg(long, default_value_t = 2, value_name = "N")]
    workers: usize,
    /// A handful of frames and steps in a temporary folder: shows that everything runs, learns nothing
    #[arg(long, conflicts_with_all = ["dataset", "resume"])]
    smoke: bool,
    /// All runs of a study that are missing, instead of one run: a name (quick, cpu, paper) or a TOML
    #[arg(long, value_name = "STUDY", conflicts_with_all = ["dataset", "detector", "seed", "epochs", "set", "init", "resume", "overfit", "smoke"])]
    study: Option<String>,
    #[command(flatten)]
    how: HowToRun,
}

impl TrainArgs {
    /// Trains, evaluates, and says where the results lie.
    pub fn run(mut self) -> Result<()> {
        if let Some(study) = &self.study {
            let study = Study::open(study, self.out.as_deref())?;
            return run_study(&study, &self.how.options(vec![Step::Data, Step::Train], &self.device));
        }
        let device = self.device.open()?;
        let temporary = (self.smoke && self.out.is_none()).then(tempfile::tempdir).transpose()?;
        if let Some(folder) = &temporary {
            self.out = Some(folder.path().into());
        }
        let (config, out) = match self.stored()? {
            Some((stored, out)) => (self.changed(stored.to_table())?, out),
            None => self.fresh()?,
        };
        eprintln!("device: {}", self.device.describe());
        // The default run has nothing to lose: a second call goes on with it.
        let resume = self.resume || self.dataset.is_none();
        let session = Session { device, device_name: self.device.describe(), workers: self.workers, resume };
        let mut progress = Progress::default();
        let trained = train(&config, &out, &session, &mut |event| progress.show(&event))?;
        progress.finish();

        let set = Dataset::open(&config.dataset)?;
        let named = ["test", config.run.val_split.as_str()].into_iter().find(|s| set.config.splits.contains_key(*s));
        let (ids, what) = match named {
            _ if config.overfit => (set.all_ids()?, "all frames, which it has learned from".to_string()),
            Some(split) => (set.ids(split)?, format!("the split {split}")),
            None => {
                eprintln!("the data set has neither a split test nor {}: not evaluated", config.run.val_split);
                return results::say_where(&out, temporary.is_none());
            }
        };
        let counter = progress::bar("{bar:30} {pos}/{len} frames evaluated, {eta} left", ids.len())?;
        let mut count = |done| counter.set_position(done as u64);
        let found = evaluate_detector(&trained.detector, &set, &ids, self.workers, &mut count)?;
        counter.finish_and_clear();
        results::show(&found, &what)?;
        results::write(&found, &set, &out)?;
        results::say_where(&out, temporary.is_none())
    }

    /// The run to go on with, if there is one: its own words need not be said again.
    fn stored(&self) -> Result<Option<(RunConfig, PathBuf)>> {
        let Some(out) = self.out.as_ref().filter(|_| self.resume) else { return Ok(None) };
        let path = out.join("config.toml");
        Ok(if path.is_file() { Some((RunConfig::read(&path)?, out.clone())) } else { None })
    }

    /// A run from the command line alone, and its folder.
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
            let frames = Dataset::open(&config.dataset)?.all_ids()?.len();
            let least = overfit_steps(&config.detector.network);
            let optimization = &mut config.detector.optimization;
            // The statistics of one frame alone are not those of all of them, which evaluation takes.
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
                let mut name = Dataset::open(dataset)?.config.name;
                if config.overfit {
                    name += "-overfit";
                }
                Path::new("runs").join(&config.detector.name).join(name).join(seed)
            }
        };
        Ok((config, out))
    }

    /// What the command line says, merged into a run's table before the one typed parse.
    fn changed(&self, mut table: Table) -> Result<RunConfig> {
        if let Some(seed) = self.seed {
            table.insert("seed".into(), Value::Integer(i64::try_from(seed).context("--seed is too large")?));
        }
        if let Some(dataset) = &self.dataset {
            Dataset::open(dataset)?;
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
    detector_text(name_or_path)?.parse().with_context(|| name_or_path.to_string())
}

/// Absolute, so that a run can be resumed from anywhere.
fn path_value(path: &Path) -> Result<Value> {
    let absolute = fs_err::canonicalize(path)?;
    match absolute.to_str() {
        Some(text) => Ok(Value::String(text.into())),
        None => bail!("{} cannot be written into a TOML: its name is not UTF-8", path.display()),
    }
}

/// The synthetic data set of the default run; frames that are there already are kept.
fn make_data(folder: &Path, smoke: bool) -> Result<PathBuf> {
    let mut road = RoadConfig::default();
    if smoke {
        road.frames = FrameCounts { train: 4, val: 1, test: 2 };
    }
    let bar = progress::bar("{bar:30} {pos}/{len} frames made, {eta} left", road.frames.total())?;
    make_road_dataset(&road, folder, &|done, _| bar.set_position(done as u64))?;
    bar.finish_and_clear();
    eprintln!("data set: {}", folder.display());
    Ok(folder.into())
}
