//! Comparison of a network with reference values: the parts that all networks share. The stages of each network are in
//! its own module.

use super::manifest::Manifest;
use super::recipe;
use super::reference::{ReferenceFile, Row, Samples, numbers};
use anyhow::{Context, Result};
use burn::tensor::{Device, Tensor};
use data::{Cloud, Frame};
use models::checkpoint::{HostTensor, HostValues, NamedTensors, read_checkpoint, read_safetensors};
use models::config::{DetectorConfig, NetworkConfig};
use models::layers::host;
use models::{Detector, Losses, named};
use std::collections::BTreeSet;
use std::path::Path;

/// Upper limit of the tolerance of a stage, independent of the rounding errors of the reference.
pub const STAGE_LIMIT: f64 = 1e-3;

/// Largest value of a gradient that is zero in exact arithmetic, as a share of the largest gradient of the network.
const ZERO_GRADIENT: f64 = 1e-5;

/// Number of repetitions of a failed gradient comparison, for small and for large networks. Gradients are discontinuous
/// where a ReLU or a maximum switches, so that rounding can decide the result. A failed comparison is repeated with
/// weights perturbed by a few units in the last place (relative change at most 1e-6) and passes if one repetition
/// passes. Small networks have narrower tolerances and need more repetitions.
const NUDGES: [u64; 2] = [64, 12];
/// Largest perturbation of a weight, units in the last place.
const NUDGED_DIGITS: u64 = 12;

/// The comparisons of one kind of detector.
pub struct DetectorChecks {
    /// `model_cfg.NAME` in the manifest.
    pub name: &'static str,
    /// The configuration of the network in the manifest.
    pub config: fn(&Manifest) -> Result<NetworkConfig>,
    /// Compares every stage of a forward pass in evaluation mode, and the detections.
    pub eval: fn(&mut Case, &Detector) -> Result<()>,
    /// Compares every stage of a forward pass in training mode; returns the losses with their autodiff graph.
    pub train: fn(&mut Case, &Detector) -> Result<Losses>,
    /// How gradients are compared.
    pub gradients: Gradients,
}

/// Tolerance of a gradient: ten times its own rounding error in the reference, at least a limit.
#[derive(Clone, Copy, Debug)]
pub struct Gradients {
    /// The limit for small and for large networks.
    pub least: [f64; 2],
    /// How the samples of a gradient are compared.
    pub samples: Samples,
}

impl Gradients {
    /// For references whose gradients depend on ReLUs that switch.
    pub const WIDE: Gradients = Gradients { least: [1e-3, 5e-2], samples: Samples::Largest };
}

/// Compares all files of the folder.
pub fn compare(folder: &Path, device: &Device) -> Result<Vec<Row>> {
    let manifest = Manifest::read(folder)?;
    let config = manifest.detector()?;
    let statistics = read_safetensors(&folder.join("bn_running_stats.safetensors"))?;
    let fresh = |device: &Device| -> Result<Detector> {
        let detector = Detector::new(&config, 0, device);
        let weights = recipe::weights(manifest.seed, &detector.to_named()?, &statistics);
        Ok(detector.load_named(&weights)?)
    };
    let mut case = Case { folder, manifest: &manifest, config: &config, rows: Vec::new() };
    case.checkpoints(&fresh(device)?)?;
    let checks = manifest.checks()?;
    (checks.eval)(&mut case, &fresh(device)?)?;
    let learning = fresh(&device.clone().autodiff())?;
    let losses = (checks.train)(&mut case, &learning)?;
    let mut gradients = case.gradients(&learning, losses.total)?;
    case.running_statistics(&learning)?;
    for trial in 0..NUDGES[usize::from(case.is_noisy())] {
        if gradients.iter().all(|row| row.pass) {
            break;
        }
        let nudged = fresh(&device.clone().autodiff())?;
        let nudged =
            nudged.clone().load_named(&recipe::nudged(nudged.to_named()?, trial, 1 + trial % NUDGED_DIGITS))?;
        let mut aside = Case { folder, manifest: &manifest, config: &config, rows: Vec::new() };
        let losses = (checks.train)(&mut aside, &nudged)?;
        let others = aside.gradients(&nudged, losses.total)?;
        gradients.iter_mut().zip(others).filter(|(row, other)| !row.pass && other.pass).for_each(|(row, o)| *row = o);
    }
    case.rows.extend(gradients);
    Ok(case.rows)
}

/// A folder with reference values, and the comparisons so far.
pub struct Case<'a> {
    folder: &'a Path,
    /// Its manifest.
    pub manifest: &'a Manifest,
    /// The configuration of the detector.
    pub config: &'a DetectorConfig,
    /// All comparisons so far.
    pub rows: Vec<Row>,
}

impl Case<'_> {
    /// Opens `NAME.safetensors` of the folder.
    pub fn file(&self, name: &str) -> Result<ReferenceFile> {
        ReferenceFile::read(self.folder, name)
    }

    /// Tolerance of a stage, for example `eval/sa0.features`.
    pub fn tolerance(&self, stage: &str) -> f64 {
        self.manifest.tolerance(stage, STAGE_LIMIT)
    }

    /// The ground truth of each frame, `[x, y, z, dx, dy, dz, yaw, class]`; padded with rows of zeros.
    pub fn ground_truth(&self, file: &mut ReferenceFile) -> Result<Vec<Vec<[f32; 8]>>> {
        let shape = file.input("in.gt_boxes")?.shape.clone();
        let rows = file.floats("in.gt_boxes")?.as_chunks::<8>().0.to_vec();
        let frames = rows.chunks(shape[1].max(1)).take(shape[0]);
        Ok(frames.map(|rows| rows.iter().filter(|b| b[7] > 0.0).copied().collect()).collect())
    }

    /// Compares the partial losses and their sum with `losses`.
    pub fn losses(&self, file: &mut ReferenceFile, losses: &Losses) -> Result<()> {
        let mut values = Vec::new();
        for part in losses.parts.iter().map(|(_, part)| part).chain([&losses.total]) {
            values.push(f64::from(host(part.clone())?[0]));
        }
        file.compare("losses", &values, self.manifest.loss_tolerance())
    }

    /// Compares the weights with the checkpoints of the folder, if there are any. Running statistics are inputs of the
    /// weight recipe.
    fn checkpoints(&mut self, detector: &Detector) -> Result<()> {
        let ours = detector.to_named()?;
        if !self.manifest.names.is_empty() {
            self.names(&ours);
        }
        let mut statistics = self.file("bn_running_stats")?;
        for name in statistics.names().map(String::from).collect::<Vec<_>>() {
            let tensor = ours.get(&name).with_context(|| format!("the network has no tensor {name}"))?;
            statistics.compare(&name, &numbers(tensor), 0.0)?;
        }
        self.rows.extend(statistics.finish());
        for name in ["checkpoint.safetensors", "checkpoint_legacy.pth", "checkpoint_zip.pth"] {
            let path = self.folder.join(name);
            if path.exists() {
                let read = read_checkpoint(&path)?;
                detector.clone().load_named(&read)?;
                for (tensor, reference) in &read {
                    let error = ours.get(tensor).map(|t| f64::from(u8::from(!same(t, reference))));
                    let row = Row {
                        file: name.into(),
                        tensor: tensor.clone(),
                        error,
                        tolerance: 0.0,
                        pass: error == Some(0.0),
                    };
                    self.rows.push(row);
                }
            }
        }
        Ok(())
    }

    /// Compares the names and shapes of all tensors with the list of the manifest.
    fn names(&mut self, ours: &NamedTensors) {
        let names: BTreeSet<&String> = ours.keys().chain(self.manifest.names.keys()).collect();
        for name in names.into_iter().filter(|name| *name != "global_step") {
            let shapes = [ours.get(name).map(|t| &t.shape), self.manifest.names.get(name)];
            let pass = shapes[0] == shapes[1];
            let error = shapes.iter().all(Option::is_some).then_some(f64::from(u8::from(!pass)));
            self.rows.push(Row { file: "manifest".into(), tensor: name.clone(), error, tolerance: 0.0, pass });
        }
    }

    /// Compares the gradients. In networks of full size they are noisy, since a ReLU that switches because of the last
    /// bit changes whole sums; see the tolerances in the description of the folder.
    fn gradients(&self, detector: &Detector, total: Tensor<1>) -> Result<Vec<Row>> {
        let gradients = named::gradients(&detector.network, &total.backward())?;
        let rule = self.manifest.checks()?.gradients;
        let limit = rule.least[usize::from(self.is_noisy())];
        let magnitude = |values: Vec<f64>| values.into_iter().map(f64::abs).fold(0.0, f64::max);
        let largest = gradients.values().map(|gradient| magnitude(numbers(gradient))).fold(0.0, f64::max);
        let mut rows = Vec::new();
        for name in ["train_grads", "train_grads_f64"] {
            let mut file = self.file(name)?;
            for (parameter, gradient) in &gradients {
                // In some small networks a ReLU switches between single and double precision of the reference.
                let natural = self.manifest.f32_minus_f64.get(&format!("grad/{parameter}"));
                if natural.is_some_and(|natural| natural.zero) {
                    file.compare_zero_gradient(parameter, &numbers(gradient), largest, ZERO_GRADIENT)?;
                    continue;
                }
                let tolerance = limit.max(10.0 * natural.and_then(|n| n.rel_l2).unwrap_or(0.0));
                file.compare_gradient(parameter, &numbers(gradient), tolerance, rule.samples)?;
            }
            rows.extend(file.finish());
        }
        Ok(rows)
    }

    /// Whether rounding affects the gradients of the reference itself, as in networks of full size.
    fn is_noisy(&self) -> bool {
        let gradients = self.manifest.f32_minus_f64.iter().filter(|(k, _)| k.starts_with("grad/"));
        let natural: Vec<f64> = gradients.filter_map(|(_, n)| n.rel_l2).collect();
        statistics::median_upper(natural).is_some_and(|median| median > 2e-5)
    }

    fn running_statistics(&mut self, detector: &Detector) -> Result<()> {
        let mut file = self.file("train_running_stats")?;
        let ours = detector.to_named()?;
        for name in file.names().map(String::from).collect::<Vec<_>>() {
            let tensor = ours.get(&name).with_context(|| format!("the network has no tensor {name}"))?;
            let tolerance = match tensor.values {
                HostValues::I64(_) => 0.0,
                _ => self.tolerance(&format!("running/{name}")),
            };
            file.compare(&name, &numbers(tensor), tolerance)?;
        }
        self.rows.extend(file.finish());
        Ok(())
    }
}

/// Whether two tensors are equal. A counter may be stored with or without a dimension.
fn same(ours: &HostTensor, reference: &HostTensor) -> bool {
    match (&ours.values, &reference.values) {
        (HostValues::I64(a), HostValues::I64(b)) if a.len() == 1 => a == b,
        _ => ours == reference,
    }
}

/// A frame with points but without objects.
pub fn frame(values: Vec<f32>, channels: usize) -> Frame {
    Frame { id: "reference".into(), cloud: Cloud { values, channels }, objects: Vec::new() }
}

/// Values in double precision.
pub fn wide(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&v| f64::from(v)).collect()
}
