//! A network against a folder of reference numbers: what all networks have in common. Their stages are in files of their own.

use super::manifest::Manifest;
use super::reference::{ReferenceFile, Row, numbers};
use super::{pointpillars, pointrcnn, recipe};
use anyhow::{Context, Result};
use burn::tensor::{Device, Tensor};
use data::{Cloud, Frame};
use models::checkpoint::{HostValues, read_checkpoint, read_safetensors};
use models::config::{DetectorConfig, NetworkConfig};
use models::layers::host;
use models::{Detector, Losses, Network, named};
use std::path::Path;

/// A stage may not differ by more than this, whatever the reference's own rounding.
pub const STAGE_LIMIT: f64 = 1e-3;

/// Compares every file of the folder.
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
    let (looking, learning) = (fresh(device)?, fresh(&device.clone().autodiff())?);
    let losses = match (&config.network, &looking.network, &learning.network) {
        (NetworkConfig::PointPillars(net), Network::PointPillars(looking), Network::PointPillars(learning)) => {
            pointpillars::eval(&mut case, net, looking)?;
            pointpillars::train(&mut case, net, learning)?
        }
        (NetworkConfig::PointRcnn(net), Network::PointRcnn(looking), Network::PointRcnn(learning)) => {
            pointrcnn::eval(&mut case, net, looking)?;
            pointrcnn::train(&mut case, net, learning)?
        }
        _ => unreachable!("a detector has the network of its configuration"),
    };
    case.gradients(&learning, losses.total)?;
    case.running_statistics(&learning)?;
    Ok(case.rows)
}

/// A folder, and what was found in it so far.
pub struct Case<'a> {
    folder: &'a Path,
    /// What it says of itself.
    pub manifest: &'a Manifest,
    /// The same detector in our words.
    pub config: &'a DetectorConfig,
    /// All comparisons.
    pub rows: Vec<Row>,
}

impl Case<'_> {
    /// `NAME.safetensors` of the folder.
    pub fn file(&self, name: &str) -> Result<ReferenceFile> {
        ReferenceFile::read(self.folder, name)
    }

    /// Tolerance of a stage, `eval/sa0.features`.
    pub fn tolerance(&self, stage: &str) -> f64 {
        self.manifest.tolerance(stage, STAGE_LIMIT)
    }

    /// The ground truth of each frame, `[x, y, z, dx, dy, dz, yaw, class]`; rows of zeros fill up.
    pub fn ground_truth(&self, file: &mut ReferenceFile) -> Result<Vec<Vec<[f32; 8]>>> {
        let shape = file.input("in.gt_boxes")?.shape.clone();
        let rows = file.floats("in.gt_boxes")?.as_chunks::<8>().0.to_vec();
        let frames = rows.chunks(shape[1].max(1)).take(shape[0]);
        Ok(frames.map(|rows| rows.iter().filter(|b| b[7] > 0.0).copied().collect()).collect())
    }

    /// Compares the parts and their sum with `losses`.
    pub fn losses(&self, file: &mut ReferenceFile, losses: &Losses) -> Result<()> {
        let mut values = Vec::new();
        for part in losses.parts.iter().map(|(_, part)| part).chain([&losses.total]) {
            values.push(f64::from(host(part.clone())?[0]));
        }
        file.compare("losses", &values, self.manifest.loss_tolerance())
    }

    /// Running statistics are inputs of the recipe; checkpoints, where there are any, hold its result.
    fn checkpoints(&mut self, detector: &Detector) -> Result<()> {
        let ours = detector.to_named()?;
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
                    let error = ours.get(tensor).map(|t| f64::from(u8::from(t != reference)));
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

    /// Gradients carry noise by nature at full size, see the tolerances in the folder's description: a ReLU that changes
    /// sides in the last bit moves whole sums.
    fn gradients(&mut self, detector: &Detector, total: Tensor<1>) -> Result<()> {
        let gradients = named::gradients(&detector.network, &total.backward())?;
        // The reference's own rounding tells small networks from published ones.
        let limit: f64 = if self.median_gradient() > 2e-5 { 5e-2 } else { 1e-3 };
        for name in ["train_grads", "train_grads_f64"] {
            let mut file = self.file(name)?;
            for (parameter, gradient) in &gradients {
                // In some small networks the reference's own single precision changes sides.
                let natural = self.manifest.f32_minus_f64.get(&format!("grad/{parameter}")).and_then(|n| n.rel_l2);
                let tolerance = limit.max(10.0 * natural.unwrap_or(0.0));
                file.compare_stage(parameter, &numbers(gradient), &gradient.shape, tolerance)?;
            }
            self.rows.extend(file.finish());
        }
        Ok(())
    }

    fn median_gradient(&self) -> f64 {
        let gradients = self.manifest.f32_minus_f64.iter().filter(|(k, _)| k.starts_with("grad/"));
        let mut natural: Vec<f64> = gradients.filter_map(|(_, n)| n.rel_l2).collect();
        natural.sort_by(f64::total_cmp);
        natural.get(natural.len() / 2).copied().unwrap_or(0.0)
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

/// A frame of points alone.
pub fn frame(values: Vec<f32>, channels: usize) -> Frame {
    Frame { id: "reference".into(), cloud: Cloud { values, channels }, objects: Vec::new() }
}

/// Values in double precision.
pub fn wide(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&v| f64::from(v)).collect()
}
