//! What a study will cost: the steps that are left, times a step measured on this machine.

use crate::config::StudyRun;
use crate::data_sets::open;
use crate::error::{InPart, Result, refused};
use crate::folder::Study;
use crate::local::own_program;
use crate::standing::{Standing, standing};
use crate::{Event, Listener};
use burn::optim::GradientsParams;
use burn::tensor::Device;
use data::{Dataset, Frame, write_json};
use models::{Detector, Preparer, predict_samples, reference_name};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::process::{Command, Stdio};
use std::time::Instant;
use train::memory::peak_mib;
use train::{Adam, GradientNorm, TrainingFrames};

/// Steps that are measured, behind one that warms up.
const MEASURED_STEPS: u64 = 5;
/// Test frames that are measured.
const MEASURED_FRAMES: usize = 3;

/// What a network costs on a machine.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NetworkCost {
    /// A training step, s.
    pub step_s: f64,
    /// A test frame, s.
    pub detection_s: f64,
    /// Largest resident memory of the process, MiB.
    pub peak_mib: u64,
    /// Threads that computed.
    pub threads: usize,
    /// Words for the device that computed.
    pub device: String,
}

/// What all networks of a study cost, by name: `costs.json`.
pub type Costs = BTreeMap<String, NetworkCost>;

/// Measures a run's network in this process. The words for the device are left empty.
///
/// # Errors
/// Frames that cannot be read, a step that fails.
pub fn measure(study: &Study, run: &StudyRun, device: &Device) -> Result<NetworkCost> {
    let config = study.run_config(run)?;
    let set = Dataset::open(&config.dataset)?;
    let frames = TrainingFrames::new(&config, &set, &run.folder(&study.folder).join("cache"))?;
    let order = frames.order(0);
    let batch_size = config.detector.optimization.batch_size;
    let mut detector = Detector::new(&config.detector, config.seed, &device.clone().autodiff());
    let mut adam = Adam::new(config.detector.optimization.weight_decay, reference_name);
    let mut seconds = Vec::new();
    for step in 0..=MEASURED_STEPS {
        let begin = Instant::now();
        let at = |i: usize| order[(step as usize * batch_size + i) % order.len()];
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

/// A machine that pauses for a moment does not change it.
fn median(values: Vec<f64>) -> f64 {
    statistics::median_upper(values).unwrap_or(0.0)
}

/// The costs that are known of a study.
pub fn known(study: &Study) -> Costs {
    let bytes = fs_err::read(study.folder.join("costs.json")).unwrap_or_default();
    serde_json::from_slice(&bytes).unwrap_or_default()
}

/// The costs of the networks of these runs: known ones, and the others measured in a process each, with so many threads. A network that
/// cannot be measured is left out, and said.
///
/// # Errors
/// A process that cannot be started, a file that cannot be written.
pub fn costs(
    study: &Study,
    runs: &[StudyRun],
    threads: usize,
    device: &[String],
    listener: Listener<'_>,
) -> Result<Costs> {
    let mut costs = known(study);
    let mut tried = BTreeSet::new();
    for run in runs {
        let network = &run.id.network;
        let is_same = |cost: &NetworkCost| cost.threads == threads && cost.device == device.join(" ");
        if !tried.insert(network) || costs.get(network).is_some_and(is_same) {
            continue;
        }
        listener(Event::Note(&format!("measuring a step of {network}")));
        let output = Command::new(own_program()?)
            .arg("study-run")
            .arg(&study.folder)
            .args(["--run", &run.to_string(), "--parts", "measure"])
            .args(device)
            .env("RAYON_NUM_THREADS", threads.to_string())
            .stdin(Stdio::null())
            .output()?;
        if !output.status.success() {
            let said = String::from_utf8_lossy(&output.stderr);
            let reason = said.trim().trim_start_matches("error: ");
            listener(Event::Note(&format!("{network} could not be measured: {reason}")));
            continue;
        }
        let mut cost: NetworkCost =
            serde_json::from_slice(&output.stdout).in_part(|| format!("{network}: no measurement"))?;
        cost.device = device.join(" ");
        costs.insert(network.clone(), cost);
        write_json(&study.folder.join("costs.json"), &costs)?;
    }
    Ok(costs)
}

/// What is left of a run, and what it takes on one process.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Left {
    /// Training steps.
    pub steps: u64,
    /// Frames to detect, those that are watched during training with them.
    pub frames: u64,
    /// Of both together, where the cost is known, s.
    pub seconds: Option<f64>,
}

/// What is left of a run that stands so.
///
/// # Errors
/// A data set that is not there.
pub fn left(study: &Study, run: &StudyRun, costs: &Costs) -> Result<Left> {
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
            // Losses and boxes: the network runs twice.
            true => 2 * dataset.ids(&config.run.val_split)?.len() as u64 * (optimization.epochs as u64).div_ceil(every),
            false => 0,
        };
        Ok((steps as u64, watched))
    };
    let (steps, frames) = match standing(study, run)? {
        Standing::Done => (0, 0),
        Standing::Trained(missing) => (0, tests(&missing)?),
        Standing::Running(step, total) | Standing::Stopped(step, total) if total > 0 => {
            let (steps, watched) = whole()?;
            (total - step, watched * (total - step) / steps.max(1) + tests(&all)?)
        }
        _ => {
            let (steps, watched) = whole()?;
            (steps, watched + tests(&all)?)
        }
    };
    let of = |cost: &NetworkCost| steps as f64 * cost.step_s + frames as f64 * cost.detection_s;
    Ok(Left { steps, frames, seconds: costs.get(&run.id.network).map(of) })
}

/// Hours, minutes or seconds, in words.
pub fn duration(seconds: f64) -> String {
    match seconds {
        s if s >= 5400.0 => format!("{:.1} h", s / 3600.0),
        s if s >= 90.0 => format!("{:.0} min", s / 60.0),
        s => format!("{s:.0} s"),
    }
}
