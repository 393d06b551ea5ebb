//! The three losses of PointPillars (OpenPCDet: `AnchorHeadTemplate.get_loss`).

use super::Sample;
use super::config::LossConfig;
use super::head::Predictions;
use crate::Losses;
use crate::loss::{add_sin_difference, cross_entropy, filled_up, sigmoid_focal_sum, smooth_l1};
use crate::row_ops;
use burn::tensor::{Tensor, TensorData};
use std::sync::Arc;

/// Weighted losses of a batch: classes over all anchors that are not ignored, boxes and directions over the positive
/// ones. Each is divided by the number of positives of its frame and by the number of frames.
///
/// # Panics
/// If a sample was prepared without targets.
pub fn losses(predictions: &Predictions, batch: &[&Sample], weights: &LossConfig) -> Losses {
    let device = predictions.cls.device();
    let [b, anchors, classes] = predictions.cls.dims();
    let mut labels = Vec::with_capacity(b * anchors);
    let mut frame_weights = Vec::with_capacity(b);
    let (mut positive, mut share, mut residuals, mut bins) = (vec![], vec![], vec![], vec![]);
    for (frame, sample) in batch.iter().enumerate() {
        let targets = sample.targets.as_ref().expect("a training sample has targets");
        let norm = 1.0 / (targets.positive.len().max(1) * b) as f32;
        labels.extend_from_slice(&targets.labels);
        frame_weights.push(norm);
        for (k, &(anchor, _)) in targets.positive.iter().enumerate() {
            positive.push((frame * anchors + anchor) as u32);
            share.push(norm);
            residuals.extend(targets.reg[k]);
            bins.push(targets.dir[k]);
        }
    }
    let tensor = |values, shape: [usize; 2]| Tensor::<2>::from_data(TensorData::new(values, shape), &device);
    let rows = b * anchors;
    let logits = predictions.cls.clone().reshape([rows, classes]);
    let cls = sigmoid_focal_sum(logits, &labels, &frame_weights) * weights.class_weight;
    let n = filled_up(positive.len());
    positive.resize(n, row_ops::ZERO);
    share.resize(n, 0.0);
    residuals.resize(7 * n, 0.0);
    bins.resize(n, 0);
    let (boxes, dir) = if n == 0 {
        (Tensor::zeros([1], &device), Tensor::zeros([1], &device))
    } else {
        let index: Arc<[u32]> = positive.into();
        let share = tensor(share, [n, 1]);
        let pred = row_ops::gather(predictions.boxes.clone().reshape([rows, 7]), &index); // [n, 7]
        let code = tensor(weights.code_weights.to_vec(), [1, 7]);
        let (pred, target) = add_sin_difference(pred, tensor(residuals, [n, 7]));
        let difference = (pred - target) * code; // [n, 7]
        let boxes = (smooth_l1(difference, 1.0 / 9.0) * share.clone()).sum() * weights.box_weight;
        let bins_a_box = predictions.dir.dims()[2];
        let logits = row_ops::gather(predictions.dir.clone().reshape([rows, bins_a_box]), &index); // [n, bins]
        let dir = (cross_entropy(logits, &bins) * share.reshape([n])).sum() * weights.direction_weight;
        (boxes, dir)
    };
    Losses { total: cls.clone() + boxes.clone() + dir.clone(), parts: vec![("cls", cls), ("box", boxes), ("dir", dir)] }
}
