//! The losses of CenterPoint (OpenPCDet: `CenterHead.get_loss`).

use super::Sample;
use super::config::CenterLossConfig;
use super::head::HeadOutputs;
use super::target_assigner::HeadTargets;
use crate::Losses;
use crate::loss::{filled_up, gaussian_focal_sum};
use crate::row_ops;
use burn::tensor::{Tensor, TensorData};

/// Weighted losses of a batch, summed over the heads: focal loss of the heat maps, divided by the number of peaks; L1
/// loss of the box codes at the cells of the boxes, divided by the number of boxes. Both numbers are those of the
/// batch, at least 1.
///
/// # Panics
/// If a sample was prepared without targets.
pub fn losses(heads: &[HeadOutputs], batch: &[&Sample], weights: &CenterLossConfig) -> Losses {
    let of_head = |(h, outputs): (usize, &HeadOutputs)| {
        let targets = batch.iter().map(|sample| &sample.targets.as_ref().expect("a training sample has targets")[h]);
        let targets: Vec<&HeadTargets> = targets.collect();
        (heat_map_loss(&outputs.hm, &targets) * weights.heat_map_weight, box_loss(outputs, &targets, weights))
    };
    let of_heads = heads.iter().enumerate().map(of_head);
    let sum = |(hm, boxes): (Tensor<1>, Tensor<1>), (other_hm, other_boxes)| (hm + other_hm, boxes + other_boxes);
    let (hm, boxes) = of_heads.reduce(sum).expect("a network has at least one head");
    Losses { total: hm.clone() + boxes.clone(), parts: vec![("hm", hm), ("box", boxes)] }
}

fn heat_map_loss(logits: &Tensor<4>, targets: &[&HeadTargets]) -> Tensor<1> {
    let heat_map: Vec<f32> = targets.iter().flat_map(|t| t.heat_map.iter().copied()).collect();
    let peaks = heat_map.iter().filter(|&&h| h == 1.0).count();
    gaussian_focal_sum(logits.clone(), heat_map, 1.0 / peaks.max(1) as f32)
}

fn box_loss(outputs: &HeadOutputs, targets: &[&HeadTargets], weights: &CenterLossConfig) -> Tensor<1> {
    let device = outputs.hm.device();
    let boxes = targets.iter().enumerate().flat_map(|(frame, t)| t.boxes.iter().flatten().map(move |b| (frame, *b)));
    let boxes: Vec<(usize, (usize, [f32; 8]))> = boxes.collect();
    let (n, rows) = (boxes.len(), filled_up(boxes.len()));
    if n == 0 {
        return Tensor::zeros([1], &device);
    }
    let pick = |map: &Tensor<4>| {
        let [b, c, h, w] = map.dims();
        let place = |&(frame, (cell, _)): &(usize, (usize, _))| (0..c).map(move |k| (frame * c + k) * h * w + cell);
        let mut index: Vec<u32> = boxes.iter().flat_map(place).map(|place| place as u32).collect();
        index.resize(rows * c, row_ops::ZERO);
        row_ops::gather(map.clone().reshape([b * c * h * w, 1]), &index.into()).reshape([rows, c]) // [rows, c]
    };
    let found = Tensor::cat(outputs.code().map(pick).to_vec(), 1); // [rows, 8]
    let (mut code, mut share) = (Vec::with_capacity(rows * 8), Vec::with_capacity(rows * 8));
    for (_, (_, target)) in &boxes {
        for (&value, &weight) in target.iter().zip(&weights.code_weights) {
            // The logarithm of a negative height is not a number; such a value is no target.
            let known = !value.is_nan();
            code.push(if known { value } else { 0.0 });
            share.push(if known { weight / n as f32 } else { 0.0 });
        }
    }
    code.resize(rows * 8, 0.0);
    share.resize(rows * 8, 0.0);
    let tensor = |values| Tensor::<2>::from_data(TensorData::new(values, [rows, 8]), &device);
    ((found - tensor(code)).abs() * tensor(share)).sum() * weights.box_weight
}
