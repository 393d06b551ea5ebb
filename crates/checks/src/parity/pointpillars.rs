//! Comparison of PointPillars with reference values: forward pass, targets, detections.

mod sizes;

use super::bev;
use super::network::{Case, DetectorChecks, Gradients, frame, wide};
use super::reference::ReferenceFile;
use anyhow::{Context, Result, bail};
use models::config::NetworkConfig;
use models::layers::{Mode, host};
use models::pointpillars::decode::{DecodeOptions, decode};
use models::pointpillars::{PointPillars, PointPillarsConfig, Preparation, Sample, Stages};
use models::{Detector, Losses, Network};

/// The comparisons of PointPillars.
pub const CHECKS: DetectorChecks =
    DetectorChecks { name: "PointPillar", config: sizes::config, eval, train, gradients: Gradients::WIDE };

fn parts<'a>(case: &Case<'a>, detector: &'a Detector) -> Result<(&'a PointPillarsConfig, &'a PointPillars)> {
    match (&case.config.network, &detector.network) {
        (NetworkConfig::PointPillars(net), Network::PointPillars(network)) => Ok((net, network)),
        _ => bail!("{} is not a PointPillars", case.config.name),
    }
}

/// Comparison in evaluation mode.
fn eval(case: &mut Case, detector: &Detector) -> Result<()> {
    let (net, network) = parts(case, detector)?;
    let mut file = case.file("eval")?;
    let preparation = Preparation::new(case.config, net);
    let sample = preparation.sample(&frame(file.floats("in.points")?, case.config.channels), false)?;
    bev::pillars(&mut file, &[&sample.input.pillars])?;
    let stages = network.forward(&[&sample], Mode::Eval);
    compare_stages(case, &mut file, "eval", &stages)?;

    let anchors = preparation.anchors();
    let [h, w] = preparation.map();
    let cell = anchors.len() / (h * w);
    let flat: Vec<f64> = anchors.iter().flatten().map(|&v| f64::from(v)).collect();
    let rotations = net.anchors[0].rotations_rad.len();
    // The reference computes y with `torch.arange`, which differs from the formula by up to one unit in the last place.
    let ulp = f64::from(f32::EPSILON);
    file.compare_stage("anchors", &flat, &[1, h, w, net.anchors.len(), rotations, 7], ulp)?;
    let x: Vec<f32> = (0..w).map(|i| anchors[i * cell][0]).collect();
    let y: Vec<f32> = (0..h).map(|i| anchors[i * w * cell][1]).collect();
    file.compare("anchor_x", &wide(&x), ulp)?;
    file.compare("anchor_y", &wide(&y), ulp)?;
    file.compare("anchors_first_cell", &flat[..cell * 7], ulp)?;

    let predictions = stages.predictions;
    let classes = predictions.cls.dims()[2];
    let (cls, boxes, dir) = (host(predictions.cls)?, host(predictions.boxes)?, host(predictions.dir)?);
    let scores: Vec<f32> = cls.iter().map(|&x| 1.0 / (1.0 + (-x).exp())).collect();
    let tolerance = |stage: &str| case.tolerance(&format!("eval/{stage}"));
    file.compare_stage("scores", &wide(&scores), &[1, anchors.len(), classes], tolerance("scores"))?;
    // Without score threshold and suppression the boxes of all anchors are returned in the order of their scores.
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
    file.compare("top100.score", &wide(&order.iter().map(|&a| best(a).0).collect::<Vec<_>>()), tolerance("scores"))?;
    let top: Vec<f64> = order.iter().flat_map(|&a| decoded[a]).map(f64::from).collect();
    file.compare("top100.boxes", &top, tolerance("decoded_boxes"))?;

    let second = case.manifest.score_thresh_2.map(|threshold| ("det2", threshold));
    for (set, threshold) in [("det", net.detection.score_threshold)].into_iter().chain(second) {
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
    case.rows.extend(file.finish());
    Ok(())
}

/// Comparison in training mode. Returns the losses with their autodiff graph.
fn train(case: &mut Case, detector: &Detector) -> Result<Losses> {
    let (net, network) = parts(case, detector)?;
    let mut file = case.file("train")?;
    let preparation = Preparation::new(case.config, net);
    let mut batch = Vec::new();
    for (f, truth) in case.ground_truth(&mut file)?.iter().enumerate() {
        let points = file.floats(&format!("in.points{f}"))?;
        let sample = preparation.sample(&frame(points, case.config.channels), true)?;
        batch.push(Sample { targets: Some(preparation.targets(truth)), ..sample });
    }
    bev::pillars(&mut file, &batch.iter().map(|s| &s.input.pillars).collect::<Vec<_>>())?;
    targets(&mut file, &batch)?;
    let batch: Vec<&Sample> = batch.iter().collect();
    let stages = network.forward(&batch, Mode::Train);
    let losses = models::pointpillars::losses(&stages.predictions, &batch, &net.loss);
    compare_stages(case, &mut file, "train", &stages)?;
    case.losses(&mut file, &losses)?;
    case.rows.extend(file.finish());
    Ok(losses)
}

fn compare_stages(case: &Case, file: &mut ReferenceFile, mode: &str, stages: &Stages) -> Result<()> {
    bev::stages(case, file, mode, &stages.bev)?;
    let predictions = &stages.predictions;
    let [h, w] = predictions.map;
    for (name, tensor) in
        [("cls_preds", &predictions.cls), ("box_preds", &predictions.boxes), ("dir_cls_preds", &predictions.dir)]
    {
        let [b, anchors, k] = tensor.dims();
        let tolerance = case.tolerance(&format!("{mode}/{name}"));
        let shape = [b, h, w, anchors * k / (h * w)];
        file.compare_stage(name, &wide(&host(tensor.clone())?), &shape, tolerance)?;
    }
    Ok(())
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
