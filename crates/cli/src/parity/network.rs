//! PointPillars against a folder of reference numbers: forward, targets, losses, gradients, running statistics, detections.

use super::manifest::Manifest;
use super::recipe;
use super::reference::{ReferenceFile, Row};
use anyhow::{Context, Result};
use burn::tensor::{Device, Tensor};
use data::{Cloud, Frame};
use models::checkpoint::{HostValues, read_checkpoint, read_safetensors};
use models::config::{DetectorConfig, NetworkConfig};
use models::layers::{Mode, host};
use models::pointpillars::decode::{DecodeOptions, decode};
use models::pointpillars::pillars::Pillars;
use models::pointpillars::{Preparation, Sample, Stages};
use models::{Detector, named};
use std::path::Path;

/// A stage may not differ by more than this, whatever the reference's own rounding.
const STAGE_LIMIT: f64 = 1e-3;
/// Losses.
const LOSS_LIMIT: f64 = 1e-5;

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
    case.eval(&fresh(device)?)?;
    case.train(&fresh(&device.clone().autodiff())?)?;
    Ok(case.rows)
}

struct Case<'a> {
    folder: &'a Path,
    manifest: &'a Manifest,
    config: &'a DetectorConfig,
    rows: Vec<Row>,
}

impl Case<'_> {
    fn file(&self, name: &str) -> Result<ReferenceFile> {
        ReferenceFile::read(self.folder, name)
    }

    /// Running statistics are inputs of the recipe; checkpoints, where there are any, hold its result.
    fn checkpoints(&mut self, detector: &Detector) -> Result<()> {
        let ours = detector.to_named()?;
        let mut statistics = self.file("bn_running_stats")?;
        for name in statistics.names().map(String::from).collect::<Vec<_>>() {
            let tensor = ours.get(&name).with_context(|| format!("the network has no tensor {name}"))?;
            statistics.compare(&name, &super::reference::numbers(tensor), 0.0)?;
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

    fn eval(&mut self, detector: &Detector) -> Result<()> {
        let mut file = self.file("eval")?;
        let NetworkConfig::PointPillars(net) = &self.config.network;
        let preparation = Preparation::new(self.config, net);
        let sample = preparation.sample(&frame(file.floats("in.points")?, self.config.channels), false)?;
        pillars(&mut file, &[&sample.pillars])?;
        let stages = detector.network.forward(std::slice::from_ref(&sample), Mode::Eval);
        self.stages(&mut file, "eval", &stages)?;

        let anchors = preparation.anchors();
        let [h, w] = preparation.map();
        let cell = anchors.len() / (h * w);
        let f64s = |values: &[f32]| values.iter().map(|&v| f64::from(v)).collect::<Vec<_>>();
        let flat: Vec<f64> = anchors.iter().flatten().map(|&v| f64::from(v)).collect();
        let rotations = net.anchors[0].rotations_rad.len();
        // The reference takes y from `torch.arange`, up to one unit in the last place off the formula.
        let ulp = f64::from(f32::EPSILON);
        file.compare_stage("anchors", &flat, &[1, h, w, net.anchors.len(), rotations, 7], ulp)?;
        let x: Vec<f32> = (0..w).map(|i| anchors[i * cell][0]).collect();
        let y: Vec<f32> = (0..h).map(|i| anchors[i * w * cell][1]).collect();
        file.compare("anchor_x", &f64s(&x), ulp)?;
        file.compare("anchor_y", &f64s(&y), ulp)?;
        file.compare("anchors_first_cell", &flat[..cell * 7], ulp)?;

        let predictions = stages.predictions;
        let classes = predictions.cls.dims()[2];
        let (cls, boxes, dir) = (host(predictions.cls)?, host(predictions.boxes)?, host(predictions.dir)?);
        let scores: Vec<f32> = cls.iter().map(|&x| 1.0 / (1.0 + (-x).exp())).collect();
        let tolerance = |stage: &str| self.manifest.tolerance(&format!("eval/{stage}"), STAGE_LIMIT);
        file.compare_stage("scores", &f64s(&scores), &[1, anchors.len(), classes], tolerance("scores"))?;
        // Without threshold and suppression every anchor's box comes out, in the order of its score.
        let everything = DecodeOptions {
            score_threshold: 0.0,
            nms_iou: 1.0,
            nms_pre: anchors.len(),
            nms_post: anchors.len(),
            ..preparation.decode_options().clone()
        };
        let decoded = models::pointpillars::decode::decode_boxes(&boxes, &dir, anchors, &everything);
        let flat: Vec<f64> = decoded.iter().flatten().map(|&v| f64::from(v)).collect();
        file.compare_stage("decoded_boxes", &flat, &[1, anchors.len(), 7], tolerance("decoded_boxes"))?;

        let best = |a: usize| {
            let of = &scores[a * classes..(a + 1) * classes];
            let label = (0..classes).fold(0, |b, c| if of[c] > of[b] { c } else { b });
            (of[label], label)
        };
        let mut order: Vec<usize> = (0..anchors.len()).collect();
        order.sort_by(|&a, &b| best(b).0.total_cmp(&best(a).0).then(a.cmp(&b)));
        order.truncate(100);
        let list = |values: Vec<usize>| values.into_iter().map(|v| v as f64).collect::<Vec<_>>();
        file.compare("top100.anchor_index", &list(order.clone()), 0.0)?;
        file.compare("top100.label", &list(order.iter().map(|&a| best(a).1 + 1).collect()), 0.0)?;
        file.compare(
            "top100.score",
            &f64s(&order.iter().map(|&a| best(a).0).collect::<Vec<_>>()),
            tolerance("scores"),
        )?;
        let top: Vec<f64> = order.iter().flat_map(|&a| decoded[a]).map(f64::from).collect();
        file.compare("top100.boxes", &top, tolerance("decoded_boxes"))?;

        let second = self.manifest.score_thresh_2.map(|threshold| ("det2", threshold));
        for (set, threshold) in [("det", self.manifest.score_thresh)].into_iter().chain(second) {
            let options = DecodeOptions { score_threshold: threshold, ..preparation.decode_options().clone() };
            let found = decode(&cls, &boxes, &dir, anchors, &options).map_err(|e| anyhow::anyhow!("{e:?}"))?;
            let name = |what: &str| format!("{set}.{what}");
            file.compare(&name("anchor_index"), &list(found.iter().map(|d| d.anchor).collect()), 0.0)?;
            file.compare(&name("labels"), &list(found.iter().map(|d| d.class + 1).collect()), 0.0)?;
            file.compare(
                &name("scores"),
                &found.iter().map(|d| f64::from(d.score)).collect::<Vec<_>>(),
                tolerance("scores"),
            )?;
            let found: Vec<f64> = found.iter().flat_map(|d| d.bbox).map(f64::from).collect();
            file.compare(&name("boxes"), &found, tolerance("decoded_boxes"))?;
        }
        self.rows.extend(file.finish());
        Ok(())
    }

    fn train(&mut self, detector: &Detector) -> Result<()> {
        let mut file = self.file("train")?;
        let NetworkConfig::PointPillars(net) = &self.config.network;
        let preparation = Preparation::new(self.config, net);
        let shape = file.input("in.gt_boxes")?.shape.clone();
        let boxes = file.floats("in.gt_boxes")?;
        let mut batch = Vec::new();
        for f in 0..shape[0] {
            let rows = boxes[f * shape[1] * 8..(f + 1) * shape[1] * 8].as_chunks::<8>().0;
            let truth: Vec<[f32; 8]> = rows.iter().filter(|b| b[7] > 0.0).copied().collect();
            let points = file.floats(&format!("in.points{f}"))?;
            let sample = preparation.sample(&frame(points, self.config.channels), true)?;
            batch.push(Sample { targets: Some(preparation.targets(&truth)), ..sample });
        }
        pillars(&mut file, &batch.iter().map(|s| &s.pillars).collect::<Vec<_>>())?;
        targets(&mut file, &batch)?;
        let stages = detector.network.forward(&batch, Mode::Train);
        let losses = models::pointpillars::losses(&stages.predictions, &batch, &net.loss);
        self.stages(&mut file, "train", &stages)?;
        let mut values = Vec::new();
        for (_, part) in &losses.parts {
            values.push(f64::from(host(part.clone())?[0]));
        }
        values.push(f64::from(host(losses.total.clone())?[0]));
        file.compare("losses", &values, LOSS_LIMIT)?;
        self.rows.extend(file.finish());
        self.gradients(detector, losses.total)?;

        let mut file = self.file("train_running_stats")?;
        let ours = detector.to_named()?;
        for name in file.names().map(String::from).collect::<Vec<_>>() {
            let tensor = ours.get(&name).with_context(|| format!("the network has no tensor {name}"))?;
            let tolerance = match tensor.values {
                HostValues::I64(_) => 0.0,
                _ => self.manifest.tolerance(&format!("running/{name}"), STAGE_LIMIT),
            };
            file.compare(&name, &super::reference::numbers(tensor), tolerance)?;
        }
        self.rows.extend(file.finish());
        Ok(())
    }

    /// Gradients carry noise by nature at full size, see the tolerances in the folder's description: a ReLU that changes
    /// sides in the last bit moves whole sums.
    fn gradients(&mut self, detector: &Detector, total: Tensor<1>) -> Result<()> {
        let gradients = named::gradients(&detector.network, &total.backward())?;
        // The reference's own rounding tells small networks from published ones.
        let limit = if self.median_gradient() > 2e-5 { 5e-2 } else { 1e-3 };
        for name in ["train_grads", "train_grads_f64"] {
            let mut file = self.file(name)?;
            for (parameter, gradient) in &gradients {
                file.compare_stage(parameter, &super::reference::numbers(gradient), &gradient.shape, limit)?;
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

    fn stages(&self, file: &mut ReferenceFile, mode: &str, stages: &Stages) -> Result<()> {
        let stage = |file: &mut ReferenceFile, name: &str, values: Vec<f32>, shape: &[usize]| {
            let tolerance = self.manifest.tolerance(&format!("{mode}/{name}"), STAGE_LIMIT);
            let values: Vec<f64> = values.into_iter().map(f64::from).collect();
            file.compare_stage(name, &values, shape, tolerance)
        };
        let p = &stages.pillar_features;
        stage(file, "pillar_features", host(p.clone())?, &p.dims())?;
        let mut maps = vec![("spatial_features".to_string(), &stages.spatial_features)];
        maps.extend(stages.backbone.blocks.iter().enumerate().map(|(i, t)| (format!("block{i}"), t)));
        maps.extend(stages.backbone.deblocks.iter().enumerate().map(|(i, t)| (format!("deblock{i}"), t)));
        maps.push(("spatial_features_2d".to_string(), &stages.backbone.spatial_features_2d));
        for (name, tensor) in maps {
            stage(file, &name, host(tensor.clone())?, &tensor.dims())?;
        }
        let predictions = &stages.predictions;
        let [h, w] = predictions.map;
        for (name, tensor) in
            [("cls_preds", &predictions.cls), ("box_preds", &predictions.boxes), ("dir_cls_preds", &predictions.dir)]
        {
            let [b, anchors, k] = tensor.dims();
            stage(file, name, host(tensor.clone())?, &[b, h, w, anchors * k / (h * w)])?;
        }
        Ok(())
    }
}

fn frame(values: Vec<f32>, channels: usize) -> Frame {
    Frame { id: "reference".into(), cloud: Cloud { values, channels }, objects: Vec::new() }
}

fn pillars(file: &mut ReferenceFile, frames: &[&Pillars]) -> Result<()> {
    let mut coords = Vec::new();
    for (b, pillars) in frames.iter().enumerate() {
        coords.extend(pillars.coords_zyx.iter().flat_map(|&[z, y, x]| [b as u32, z, y, x]).map(f64::from));
    }
    file.compare("pillar.coords_bzyx", &coords, 0.0)?;
    let counts: Vec<f64> = frames.iter().flat_map(|p| p.num_points.iter().map(|&n| f64::from(n))).collect();
    file.compare("pillar.num_points", &counts, 0.0)
}

fn targets(file: &mut ReferenceFile, batch: &[Sample]) -> Result<()> {
    let (mut labels, mut residuals, mut weights) = (Vec::new(), Vec::new(), Vec::new());
    let (mut positive, mut positive_label, mut positive_reg, mut positive_dir) = (vec![], vec![], vec![], vec![]);
    let mut ignored = Vec::new();
    let mut anchors = 0;
    for (f, sample) in batch.iter().enumerate() {
        let targets = sample.targets.as_ref().context("a training sample has targets")?;
        anchors = targets.labels.len();
        let from = labels.len();
        labels.extend(targets.labels.iter().map(|&l| f64::from(l)));
        residuals.resize((from + anchors) * 7, 0.0);
        weights.resize(from + anchors, 0.0);
        for (k, &(anchor, _)) in targets.positive.iter().enumerate() {
            positive.extend([f as f64, anchor as f64]);
            positive_label.push(f64::from(targets.labels[anchor]));
            positive_dir.push(targets.dir[k] as f64);
            for (c, &r) in targets.reg[k].iter().enumerate() {
                positive_reg.push(f64::from(r));
                residuals[(from + anchor) * 7 + c] = f64::from(r);
            }
            weights[from + anchor] = 1.0;
        }
        let unsure = targets.labels.iter().enumerate().filter(|(_, l)| **l < 0);
        ignored.extend(unsure.flat_map(|(a, _)| [f as f64, a as f64]));
    }
    let frames = batch.len();
    file.compare_stage("target.box_cls_labels", &labels, &[frames, anchors], 0.0)?;
    file.compare_stage("target.box_reg_targets", &residuals, &[frames, anchors, 7], 1e-6)?;
    file.compare_stage("target.reg_weights", &weights, &[frames, anchors], 1e-6)?;
    file.compare("target.positive_index", &positive, 0.0)?;
    file.compare("target.positive_label", &positive_label, 0.0)?;
    file.compare("target.positive_reg", &positive_reg, 1e-6)?;
    file.compare("target.positive_dir", &positive_dir, 0.0)?;
    file.compare("target.ignored_index", &ignored, 0.0)
}
