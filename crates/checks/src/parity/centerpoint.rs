//! Comparison of CenterPoint with reference values: forward pass, targets, detections.

mod sizes;

use super::bev;
use super::network::{Case, DetectorChecks, Gradients, frame};
use super::reference::{ReferenceFile, Samples};
use anyhow::{Context, Result, bail};
use models::centerpoint::decode::CenterBox;
use models::centerpoint::{CenterPoint, CenterPointConfig, Preparation, Sample, Stages};
use models::config::NetworkConfig;
use models::layers::Mode;
use models::{Detector, Losses, Network};

/// The comparisons of CenterPoint.
pub const CHECKS: DetectorChecks = DetectorChecks {
    name: "CenterPoint",
    config: sizes::config,
    eval,
    train,
    gradients: Gradients { least: [1e-6, 1e-6], samples: Samples::Rms },
};

fn parts<'a>(case: &Case<'a>, detector: &'a Detector) -> Result<(&'a CenterPointConfig, &'a CenterPoint)> {
    match (&case.config.network, &detector.network) {
        (NetworkConfig::CenterPoint(net), Network::CenterPoint(network)) => Ok((net, network)),
        _ => bail!("{} is not a CenterPoint", case.config.name),
    }
}

/// Start of the names of the tensors of a head; the tensors of a single head have no number.
fn prefix(head: usize, heads: usize) -> String {
    if heads == 1 { String::new() } else { format!("head{head}.") }
}

/// Comparison in evaluation mode.
fn eval(case: &mut Case, detector: &Detector) -> Result<()> {
    let (net, network) = parts(case, detector)?;
    let mut file = case.file("eval")?;
    let preparation = Preparation::new(case.config, net);
    let sample = preparation.sample(&frame(file.floats("in.points")?, case.config.channels), false)?;
    bev::pillars(&mut file, &[&sample.input.pillars])?;
    let stages = network.forward(&[&sample], Mode::Eval, &mut |_| ());
    compare_stages(case, &mut file, "eval", &stages)?;

    let boxes = preparation.boxes(&stages.heads, &[&sample])?;
    let heads = &boxes[0];
    for (h, [best, _]) in heads.iter().enumerate() {
        // Labels of the best cells count the classes of their head, labels of detections those of the detector.
        let classes = &net.heads(case.config)[h];
        let label = |found: &CenterBox| classes.iter().position(|&class| class == found.class).unwrap_or(0);
        compare_boxes(case, &mut file, &format!("{}top", prefix(h, heads.len())), best, label)?;
    }
    let kept: Vec<CenterBox> = heads.iter().flat_map(|[_, kept]| kept.iter().cloned()).collect();
    compare_boxes(case, &mut file, "det", &kept, |found| found.class)?;
    case.rows.extend(file.finish());
    Ok(())
}

/// Compares boxes, scores and labels; `label` counts from 0.
fn compare_boxes(
    case: &Case,
    file: &mut ReferenceFile,
    set: &str,
    found: &[CenterBox],
    label: impl Fn(&CenterBox) -> usize,
) -> Result<()> {
    let found = in_reference_order(case, file, set, found)?;
    let boxes: Vec<f64> = found.iter().flat_map(|b| b.bbox).map(f64::from).collect();
    let scores: Vec<f64> = found.iter().map(|b| f64::from(b.score)).collect();
    let labels: Vec<f64> = found.iter().map(|&b| (label(b) + 1) as f64).collect();
    for (what, values, shape) in [("boxes", boxes, vec![found.len(), 7]), ("scores", scores, vec![found.len()])] {
        let tolerance = case.tolerance(&format!("eval/{set}.{what}"));
        file.compare_stage(&format!("{set}.{what}"), &values, &shape, tolerance)?;
    }
    file.compare(&format!("{set}.labels"), &labels, 0.0)
}

/// The boxes in the order of the reference. Boxes by falling score have no defined order where scores differ by less
/// than their rounding errors; among those the nearest box is taken.
fn in_reference_order<'a>(
    case: &Case,
    file: &mut ReferenceFile,
    set: &str,
    found: &'a [CenterBox],
) -> Result<Vec<&'a CenterBox>> {
    let mut rest: Vec<&CenterBox> = found.iter().collect();
    let (scores, boxes) = (file.floats(&format!("{set}.scores"))?, file.floats(&format!("{set}.boxes"))?);
    if scores.len() != found.len() || boxes.len() != 7 * found.len() {
        return Ok(rest);
    }
    let tolerance = case.tolerance(&format!("eval/{set}.scores")) as f32;
    let mut ordered = Vec::with_capacity(found.len());
    for (&score, bbox) in scores.iter().zip(boxes.as_chunks::<7>().0) {
        let distance = |b: &CenterBox| b.bbox.iter().zip(bbox).map(|(a, b)| (a - b).abs()).sum::<f32>();
        let close = |b: &CenterBox| (b.score - score).abs() <= tolerance * score;
        let candidates = rest.iter().enumerate().filter(|(_, b)| close(b));
        let nearest = candidates.min_by(|(_, a), (_, b)| distance(a).total_cmp(&distance(b)));
        ordered.push(rest.remove(nearest.map_or(0, |(i, _)| i)));
    }
    Ok(ordered)
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
    targets(case, &mut file, &preparation, &batch)?;
    let batch: Vec<&Sample> = batch.iter().collect();
    let stages = network.forward(&batch, Mode::Train, &mut |_| ());
    let losses = models::centerpoint::losses(&stages.heads, &batch, &net.loss);
    compare_stages(case, &mut file, "train", &stages)?;
    case.losses(&mut file, &losses)?;
    case.rows.extend(file.finish());
    Ok(losses)
}

fn compare_stages(case: &Case, file: &mut ReferenceFile, mode: &str, stages: &Stages) -> Result<()> {
    bev::stages(case, file, mode, &stages.bev)?;
    bev::stage(case, file, mode, "shared_conv", &stages.shared)?;
    for (h, outputs) in stages.heads.iter().enumerate() {
        let prefix = prefix(h, stages.heads.len());
        for (name, map) in [
            ("hm", &outputs.hm),
            ("center", &outputs.center),
            ("center_z", &outputs.center_z),
            ("dim", &outputs.dim),
            ("rot", &outputs.rot),
        ] {
            bev::stage(case, file, mode, &format!("{prefix}{name}"), map)?;
        }
    }
    Ok(())
}

/// The reference has a fixed number of boxes in every frame; those that do not exist are zero.
fn targets(case: &Case, file: &mut ReferenceFile, preparation: &Preparation, batch: &[Sample]) -> Result<()> {
    let frames = batch.iter().map(|sample| sample.targets.as_ref().context("a training sample has targets"));
    let frames = frames.collect::<Result<Vec<_>>>()?;
    let [rows, columns] = preparation.grid().map;
    let heads = frames.first().map_or(0, |targets| targets.len());
    for h in 0..heads {
        let prefix = prefix(h, heads);
        let of_head = || frames.iter().map(move |targets| &targets[h]);
        let slots = of_head().map(|t| t.boxes.iter().flatten().count()).max().unwrap_or(0).max(1);
        let heat_map: Vec<f64> = of_head().flat_map(|t| t.heat_map.iter().map(|&v| f64::from(v))).collect();
        let classes = heat_map.len() / (batch.len() * rows * columns);
        let (mut codes, mut cells, mut mask) = (Vec::new(), Vec::new(), Vec::new());
        for targets in of_head() {
            for slot in 0..slots {
                let found = targets.boxes.get(slot).copied().flatten();
                let (cell, code) = found.unwrap_or_default();
                codes.extend(code.map(f64::from));
                cells.push(cell as f64);
                mask.push(f64::from(u8::from(found.is_some())));
            }
        }
        let name = |what: &str| format!("{prefix}target.{what}");
        let tolerance = |what: &str| case.tolerance(&format!("train/{}", name(what)));
        let shape = [batch.len(), classes, rows, columns];
        file.compare_stage(&name("heatmap"), &heat_map, &shape, tolerance("heatmap"))?;
        file.compare_stage(&name("boxes"), &codes, &[batch.len(), slots, 8], tolerance("boxes"))?;
        file.compare(&name("inds"), &cells, 0.0)?;
        file.compare(&name("mask"), &mask, 0.0)?;
    }
    Ok(())
}
