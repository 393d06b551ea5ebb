//! Expected computing time of a study: the number of remaining steps times the measured time of a step.

use crate::config::StudyRun;
use crate::data_sets::open;
use crate::error::{InPart, Result, refused};
use crate::folder::Study;
use crate::local::current_program;
use crate::run_state::{RunState, run_state};
use crate::{Event, Listener};
use burn::optim::GradientsParams;
use burn::tensor::Device;
use data::{Dataset, Frame, write_json};
use models::{Detector, Preparer, predict_samples, reference_name};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Instant;
use train::memory::peak_mib;
use train::{Adam, GradientNorm, TrainingFrames};

/// Number of measured training steps, after one warm-up step.
const MEASURED_STEPS: u64 = 5;
/// Number of measured test frames.
const MEASURED_FRAMES: usize = 3;

/// Time and memory of a network on a machine.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct NetworkCost {
    /// Time of a training step, s.
    pub step_s: f64,
    /// Time of the detection on a test frame, s.
    pub detection_s: f64,
    /// Peak resident memory of the process, MiB.
    pub peak_mib: u64,
    /// Number of threads.
    pub threads: usize,
    /// Command line arguments of the device.
    pub device: String,
}

/// Version of [`CostsFile`].
pub(crate) const COSTS_SCHEMA: &str = "lidarshift/study-costs/1";

/// The content of `costs.json`.
#[derive(Serialize, Deserialize, JsonSchema)]
pub(crate) struct CostsFile {
    /// [`COSTS_SCHEMA`].
    schema: String,
    /// By name of the network.
    networks: Costs,
}

/// Costs of the networks of a study by name, stored in `costs.json`.
pub type Costs = BTreeMap<String, NetworkCost>;

/// Measures the network of a run in this process, with this folder for cached files. The arguments of the device are
/// left empty.
///
/// # Errors
/// Frames that cannot be read, a failing step.
pub fn measure(study: &Study, run: &StudyRun, cache: &Path, device: &Device) -> Result<NetworkCost> {
    let config = study.run_config(run)?;
    let set = Dataset::open(&config.dataset)?;
    let frames = TrainingFrames::new(&config, &set, cache)?;
    let batch_size = config.detector.optimization.batch_size;
    let mut detector = Detector::new(&config.detector, config.seed, &device.clone().autodiff());
    let mut adam = Adam::new(config.detector.optimization.weight_decay, reference_name);
    let mut seconds = Vec::new();
    for step in 0..=MEASURED_STEPS {
        let begin = Instant::now();
        let at = |i: usize| frames.index(0, (step as usize * batch_size + i) % frames.ids().len());
        let batch = (0..batch_size).map(|i| frames.sample(0, at(i))).collect::<Result<Vec<_>, _>>()?;
        let losses = detector.loss(&batch)?;
        let gradients = GradientsParams::from_grads(losses.total.backward(), &detector.network);
        let norm = GradientNorm::of(&detector.network, &gradients, reference_name);
        let clip = norm.clip_scale(config.detector.optimization.clip_norm);
        detector.network = adam.step(detector.network.clone(), gradients, clip, (1e-5, 0.9));
        device.sync().map_err(|e| refused(e.to_string()))?;
        seconds.push(begin.elapsed().as_secs_f64());
    }
    let test = open(study, study.feature_set())?;
    let preparer = Preparer::new(&config.detector);
    let mut detection = Vec::new();
    for id in test.ids(&study.config.splits.test)?.iter().take(MEASURED_FRAMES) {
        let begin = Instant::now();
        let sample = preparer.inference(&Frame { id: id.clone(), cloud: test.load_cloud(id)?, objects: Vec::new() })?;
        predict_samples(&detector, &[sample])?;
        detection.push(begin.elapsed().as_secs_f64());
    }
    Ok(NetworkCost {
        step_s: median(seconds.split_off(1)),
        detection_s: median(detection),
        peak_mib: peak_mib().unwrap_or(0),
        threads: rayon::current_num_threads(),
        device: String::new(),
    })
}

/// Median, which is robust against short pauses of the machine.
fn median(values: Vec<f64>) -> f64 {
    statistics::median_upper(values).unwrap_or(0.0)
}

/// The costs that have been measured for a study.
pub fn known_costs(study: &Study) -> Costs {
    let bytes = fs_err::read(study.folder.join("costs.json")).unwrap_or_default();
    serde_json::from_slice::<CostsFile>(&bytes).map(|file| file.networks).unwrap_or_default()
}

/// The costs of the networks of these runs. Unknown costs are measured in one process per network with `threads`
/// threads. A network that cannot be measured is left out with a note. With `dry_run` only `costs.json` is written.
///
/// # Errors
/// A process that cannot be started, a file that cannot be written.
pub fn costs(
    study: &Study,
    runs: &[StudyRun],
    threads: usize,
    (device, dry_run): (&[String], bool),
    listener: Listener<'_>,
) -> Result<Costs> {
    let mut costs = known_costs(study);
    let mut tried = BTreeSet::new();
    for run in runs {
        let network = &run.id.network;
        let is_same = |cost: &NetworkCost| cost.threads == threads && cost.device == device.join(" ");
        if !tried.insert(network) || costs.get(network).is_some_and(is_same) {
            continue;
        }
        listener(Event::Note(&format!("measuring the step time of {network}")));
        let mut command = Command::new(current_program()?);
        // The folder may have no copy of the study's TOML, or that of an earlier version.
        match dry_run && !study.is_copied() {
            true => command.arg("study-run").arg(&study.named).arg("--out").arg(&study.folder),
            false => command.arg("study-run").arg(&study.folder),
        };
        let output = command
            .args(["--run", &run.to_string(), "--parts", if dry_run { "measure-only" } else { "measure" }])
            .args(device)
            .env("RAYON_NUM_THREADS", threads.to_string())
            .stdin(Stdio::null())
            .output()?;
        if !output.status.success() {
            let message = String::from_utf8_lossy(&output.stderr);
            let reason = message.trim().trim_start_matches("error: ");
            listener(Event::Note(&format!("{network} could not be measured: {reason}")));
            continue;
        }
        let mut cost: NetworkCost = serde_json::from_slice(&output.stdout)
            .in_part(|| format!("{network}: unexpected output of the measurement"))?;
        cost.device = device.join(" ");
        costs.insert(network.clone(), cost);
        let file = CostsFile { schema: COSTS_SCHEMA.into(), networks: costs.clone() };
        write_json(&study.folder.join("costs.json"), &file)?;
    }
    Ok(costs)
}

/// Remaining work of a run, and its time in one process.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Remaining {
    /// Remaining training steps.
    pub steps: u64,
    /// Remaining frames to detect, including those of the validation during training.
    pub frames: u64,
    /// Time of both, s, if the cost is known.
    pub seconds: Option<f64>,
}

/// Remaining work of a run.
///
/// # Errors
/// A missing data set.
pub fn remaining(study: &Study, run: &StudyRun, costs: &Costs) -> Result<Remaining> {
    let tests = |names: &[String]| -> Result<u64> {
        names.iter().map(|name| Ok(open(study, name)?.ids(&study.config.splits.test)?.len() as u64)).sum()
    };
    let all: Vec<String> = study.config.datasets.iter().map(|d| d.name.clone()).collect();
    let whole = || -> Result<(u64, u64)> {
        let config = study.run_config(run)?;
        let dataset = Dataset::open(&config.dataset)?;
        let (optimization, every) = (&config.detector.optimization, config.run.evaluate_every_epochs);
        let steps = dataset.ids(&config.run.train_split)?.len().div_ceil(optimization.batch_size) * optimization.epochs;
        let watched = match dataset.config.splits.contains_key(&config.run.val_split) && every > 0 {
            // Validation runs the network twice: for losses and for boxes.
            true => 2 * dataset.ids(&config.run.val_split)?.len() as u64 * (optimization.epochs as u64).div_ceil(every),
            false => 0,
        };
        Ok((steps as u64, watched))
    };
    let (steps, frames) = match run_state(study, run)? {
        RunState::Done => (0, 0),
        RunState::Trained(missing) => (0, tests(&missing)?),
        RunState::Running(step, total) | RunState::Stopped(step, total) if total > 0 => {
            let (steps, watched) = whole()?;
            (total - step, watched * (total - step) / steps.max(1) + tests(&all)?)
        }
        _ => {
            let (steps, watched) = whole()?;
            (steps, watched + tests(&all)?)
        }
    };
    let of = |cost: &NetworkCost| steps as f64 * cost.step_s + frames as f64 * cost.detection_s;
    Ok(Remaining { steps, frames, seconds: costs.get(&run.id.network).map(of) })
}

/// Text with hours, minutes or seconds.
pub fn duration(seconds: f64) -> String {
    match seconds {
        s if s >= 5400.0 => format!("{:.1} h", s / 3600.0),
        s if s >= 90.0 => format!("{:.0} min", s / 60.0),
        s => format!("{s:.0} s"),
    }
}
