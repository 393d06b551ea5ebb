//! The losses of a batch: both stages in one pass, as OpenPCDet trains them.

use super::loss::{point_losses, roi_losses};
use super::network::PointRcnn;
use super::proposals::{point_boxes, proposals};
use super::roi_input::{RoiInput, Scene};
use super::roi_targets::{RoiTargets, sample as sample_rois};
use super::sample::{Preparation, Sample};
use crate::layers::{Mode, host};
use crate::{Losses, ModelError};
use burn::tensor::Tensor;
use data::stream;
use rayon::prelude::*;

/// Weighted losses of a batch. Frames without points are skipped; a batch of such frames has losses of 0.
///
/// # Panics
/// If a sample was prepared without targets.
///
/// # Errors
/// Tensors that are not f32.
pub fn losses(
    network: &PointRcnn,
    batch: &[&Sample],
    preparation: &Preparation,
    mode: Mode,
) -> Result<Losses, ModelError> {
    let batch: Vec<&Sample> = batch.iter().copied().filter(|s| !s.points.is_empty()).collect();
    let names = ["point_cls", "point_box", "rcnn_cls", "rcnn_reg", "rcnn_corner"];
    if batch.is_empty() {
        // Depends on a weight, so that there is an autodiff graph.
        let nothing = network.point_head.cls_layers.last.bias.val().sum() * 0.0;
        let parts = names.map(|name| (name, nothing.clone())).to_vec();
        return Ok(Losses { total: nothing, parts });
    }
    let net = &preparation.net;
    let stages = network.points(&batch, mode);
    let targets: Vec<_> = batch.iter().map(|s| s.targets.as_ref().expect("a training sample has targets")).collect();
    let of_points: Vec<_> = targets.iter().map(|t| &t.points).collect();
    let [point_cls, point_box] = point_losses(&stages.predictions, &of_points, &net.loss);

    let (logits, codes) = (host(stages.predictions.cls.clone())?, host(stages.predictions.boxes.clone())?);
    let classes = preparation.mean_sizes.len();
    let mut first_rows = Vec::new();
    let mut rows = 0;
    for sample in &batch {
        first_rows.push(rows);
        rows += sample.points.len();
    }
    let regions: Vec<(RoiTargets, RoiInput)> = (0..batch.len())
        .into_par_iter()
        .map(|f| {
            let (points, first) = (&batch[f].points, first_rows[f]);
            let logits = &logits[first * classes..][..points.len() * classes];
            let codes = &codes[first * super::POINT_CODE..][..points.len() * super::POINT_CODE];
            let boxes = point_boxes(points, logits, codes, &preparation.mean_sizes);
            let found = proposals(&boxes, logits, classes, &net.proposals.train);
            let mut random = stream(targets[f].roi_seed, "regions", 0, 0);
            let drawn = sample_rois(&found, &targets[f].boxes, &net.roi_sampling, &mut random);
            let scores = point_scores(logits, classes);
            let scene = Scene { points, scores: &scores, first_row: first as u32 };
            let input = RoiInput::new(scene, &drawn.rois, &net.roi_head);
            (drawn, input)
        })
        .collect();
    let (mut drawn, mut input) = (RoiTargets::default(), RoiInput::empty(&net.roi_head));
    for (targets, region) in &regions {
        drawn.append(targets);
        input.append(region);
    }
    let roi = network.roi_head.forward(stages.point_features(), &input, mode);
    let [rcnn_cls, rcnn_reg, rcnn_corner] = roi_losses(roi.cls, roi.reg, &drawn, &net.loss);
    let parts = [point_cls, point_box, rcnn_cls, rcnn_reg, rcnn_corner];
    let total = parts.iter().cloned().reduce(|sum: Tensor<1>, part| sum + part).expect("five parts");
    Ok(Losses { total, parts: names.into_iter().zip(parts).collect() })
}

/// Sigmoid of each point's largest logit.
pub fn point_scores(logits: &[f32], classes: usize) -> Vec<f32> {
    let largest = logits.chunks_exact(classes).map(|of| of.iter().copied().fold(f32::NEG_INFINITY, f32::max));
    largest.map(|logit| 1.0 / (1.0 + (-logit).exp())).collect()
}
