//! The five losses of PointRCNN (OpenPCDet: `PointHeadTemplate`, `RoIHeadTemplate`).

use super::box_coder::{CORNER_SIGNS, corners};
use super::config::PointRcnnLossConfig;
use super::point_head::{POINT_CODE, PointPredictions};
use super::point_targets::PointTargets;
use super::roi_targets::RoiTargets;
use crate::loss::{filled_up, sigmoid_focal, smooth_l1};
use crate::row_ops;
use burn::tensor::{Device, Tensor, TensorData};

/// Beta of the smooth L1 loss of codes and residuals.
const BETA: f64 = 1.0 / 9.0;

/// Squared lengths are clamped to at least this, m2, because the square root has no gradient at 0.
const LEAST_LENGTH2_M2: f64 = 1e-20;

fn rows(values: Vec<f32>, shape: [usize; 2], device: &Device) -> Tensor<2> {
    Tensor::from_data(TensorData::new(values, shape), device)
}

/// Weighted losses of the points: classes over all points that are not ignored, boxes over the positive ones. Both are
/// divided by the number of positives of the whole batch.
///
/// # Shapes
/// `predictions`: rows sorted by frame; results `[1]`.
pub fn point_losses(
    predictions: &PointPredictions,
    targets: &[&PointTargets],
    weights: &PointRcnnLossConfig,
) -> [Tensor<1>; 2] {
    let device = predictions.cls.device();
    let [points, classes] = predictions.cls.dims();
    let (mut one_hot, mut counts) = (vec![0.0; points * classes], vec![0.0; points]);
    let (mut positive, mut codes) = (Vec::new(), Vec::new());
    let mut first = 0;
    for target in targets {
        for (i, &label) in target.labels.iter().enumerate() {
            counts[first + i] = f32::from(label >= 0);
            if label > 0 {
                one_hot[(first + i) * classes + label as usize - 1] = 1.0;
            }
        }
        positive.extend(target.positive.iter().map(|(i, _)| (first + i) as u32));
        codes.extend_from_slice(target.codes.as_flattened());
        first += target.labels.len();
    }
    let n = positive.len();
    let share = 1.0 / n.max(1) as f64;
    let focal = sigmoid_focal(predictions.cls.clone(), rows(one_hot, [points, classes], &device));
    let cls = (focal * rows(counts, [points, 1], &device)).sum() * (share * f64::from(weights.point_class_weight));
    if n == 0 {
        return [cls, Tensor::zeros([1], &device)];
    }
    let filled = filled_up(n);
    positive.resize(filled, row_ops::ZERO);
    codes.resize(filled * POINT_CODE, 0.0);
    let predicted = row_ops::gather(predictions.boxes.clone(), &positive.into()); // [filled, 8]
    let code_weights = rows(weights.point_code_weights.to_vec(), [1, POINT_CODE], &device);
    let difference = (predicted - rows(codes, [filled, POINT_CODE], &device)) * code_weights;
    let boxes = smooth_l1(difference, BETA).sum() * (share * f64::from(weights.point_box_weight));
    [cls, boxes]
}

/// Weighted losses of the regions: score, box residuals, corners.
///
/// # Shapes
/// `cls`: `[R, 1]`, `reg`: `[R, 7]`; results `[1]`.
pub fn roi_losses(
    cls: Tensor<2>,
    reg: Tensor<2>,
    targets: &RoiTargets,
    weights: &PointRcnnLossConfig,
) -> [Tensor<1>; 3] {
    let device = cls.device();
    let regions = targets.rois.len();
    let cls = roi_cross_entropy(cls.reshape([regions]), &targets.labels) * f64::from(weights.roi_class_weight);
    let learned: Vec<usize> = (0..regions).filter(|&r| targets.box_counts[r]).collect();
    let n = learned.len();
    if n == 0 {
        return [cls, Tensor::zeros([1], &device), Tensor::zeros([1], &device)];
    }
    // What fills up the rows is the first region, without residuals: it is its own ground truth, and has no loss.
    let filled = filled_up(n);
    let mut places: Vec<u32> = learned.iter().map(|&r| r as u32).collect();
    places.resize(filled, row_ops::ZERO);
    let reg = row_ops::gather(reg, &places.into()); // [filled, 7]
    let mut residuals: Vec<f32> = learned.iter().flat_map(|&r| targets.residuals[r]).collect();
    residuals.resize(filled * 7, 0.0);
    let residuals = rows(residuals, [filled, 7], &device);
    let code_weights = rows(weights.roi_code_weights.to_vec(), [1, 7], &device);
    let difference = (reg.clone() - residuals) * code_weights;
    let boxes = smooth_l1(difference, BETA).sum() * (f64::from(weights.roi_box_weight) / n as f64);

    let mut rois: Vec<[f32; 7]> = learned.iter().map(|&r| targets.rois[r]).collect();
    let mut truth: Vec<[f32; 7]> = learned.iter().map(|&r| std::array::from_fn(|i| targets.truth[r][i])).collect();
    rois.resize(filled, rois[0]);
    truth.resize(filled, rois[0]);
    let corner =
        corner_loss(decode_in_regions(reg, &rois), &truth).sum() * (f64::from(weights.corner_weight) / n as f64);
    [cls, boxes, corner]
}

/// Binary cross entropy of the regions' scores, mean over those whose label is not -1.
///
/// The reference takes logarithms of the sigmoid and clamps them at -100; this form keeps full precision there.
///
/// # Shapes
/// `logits`: `[R]`; result `[1]`.
pub fn roi_cross_entropy(logits: Tensor<1>, labels: &[i32]) -> Tensor<1> {
    let device = logits.device();
    let vector = |values: Vec<f32>| Tensor::<1>::from_data(TensorData::new(values, [labels.len()]), &device);
    let counts = labels.iter().filter(|&&l| l >= 0).count().max(1);
    let is_object = vector(labels.iter().map(|&l| f32::from(l > 0)).collect());
    let share = vector(labels.iter().map(|&l| f32::from(l >= 0) / counts as f32).collect());
    let entropy = logits.clone().clamp_min(0.0) - logits.clone() * is_object + (-logits.abs()).exp().log1p();
    (entropy * share).sum()
}

/// The boxes of residuals relative to their regions.
///
/// # Shapes
/// `reg`: `[n, 7]`; result `[n, 7]`, `[x, y, z, dx, dy, dz, yaw]`, LiDAR frame.
pub fn decode_in_regions(reg: Tensor<2>, rois: &[[f32; 7]]) -> Tensor<2> {
    let device = reg.device();
    let n = rois.len();
    let column = |of: &dyn Fn(&[f32; 7]) -> f32| rows(rois.iter().map(of).collect(), [n, 1], &device);
    let predicted = |from: usize, length: usize| reg.clone().narrow(1, from, length);
    let diagonal = column(&|r| (r[3] * r[3] + r[4] * r[4]).sqrt());
    let (x, y, z) =
        (predicted(0, 1) * diagonal.clone(), predicted(1, 1) * diagonal, predicted(2, 1) * column(&|r| r[5])); // [n, 1]
    // [n, 3]
    let size = predicted(3, 3).exp() * rows(rois.iter().flat_map(|r| [r[3], r[4], r[5]]).collect(), [n, 3], &device);
    let yaw = predicted(6, 1) + column(&|r| r[6]);
    let (sin, cos) = (column(&|r| r[6].sin()), column(&|r| r[6].cos()));
    let turned =
        [x.clone() * cos.clone() - y.clone() * sin.clone() + column(&|r| r[0]), x * sin + y * cos + column(&|r| r[1])];
    let [x, y] = turned;
    Tensor::cat(vec![x, y, z + column(&|r| r[2]), size, yaw], 1)
}

/// Corner loss: smooth L1 (beta 1) of the distances between the corners of two boxes, mean over the eight. Each
/// distance is the smaller one to the ground truth and to the ground truth rotated by pi.
///
/// # Shapes
/// `boxes`: `[n, 7]`; `truth`: n boxes; result `[n]`.
pub fn corner_loss(boxes: Tensor<2>, truth: &[[f32; 7]]) -> Tensor<1> {
    let device = boxes.device();
    let n = truth.len();
    let block = |values: Vec<f32>, shape: [usize; 3]| Tensor::<3>::from_data(TensorData::new(values, shape), &device);
    let signs = block(CORNER_SIGNS.iter().flatten().map(|s| s / 2.0).collect(), [1, 8, 3]);
    // [n, 1, length]
    let part = |from: usize, length: usize| boxes.clone().narrow(1, from, length).reshape([n, 1, length]);
    let local = part(3, 3) * signs; // [n, 8, 3]
    let axis = |i: usize| local.clone().narrow(2, i, 1); // [n, 8, 1]
    let (sin, cos) = (part(6, 1).sin(), part(6, 1).cos());
    let x = axis(0) * cos.clone() - axis(1) * sin.clone();
    let y = axis(0) * sin + axis(1) * cos;
    let ours = Tensor::cat(vec![x, y, axis(2)], 2) + part(0, 3); // [n, 8, 3]
    let distance = |half_turns: f32| {
        let turned = |b: &[f32; 7]| [b[0], b[1], b[2], b[3], b[4], b[5], b[6] + half_turns * std::f32::consts::PI];
        let theirs = block(truth.iter().flat_map(|b| corners(turned(b))).flatten().collect(), [n, 8, 3]);
        let apart = ours.clone() - theirs;
        (apart.clone() * apart).sum_dim(2).clamp_min(LEAST_LENGTH2_M2).sqrt().reshape([n, 8])
    };
    let nearer = distance(0.0).min_pair(distance(1.0)); // [n, 8]
    smooth_l1(nearer, 1.0).mean_dim(1).reshape([n])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layers::host;

    #[test]
    fn no_positive_point_and_only_ignored_regions() {
        let device = Device::flex().autodiff();
        let predictions =
            PointPredictions { cls: Tensor::zeros([4, 2], &device), boxes: Tensor::zeros([4, POINT_CODE], &device) };
        let targets = PointTargets { labels: vec![0, -1, 0, 0], ..PointTargets::default() };
        let [cls, boxes] = point_losses(&predictions, &[&targets], &PointRcnnLossConfig::default());
        assert!(host(cls).unwrap()[0] > 0.0 && host(boxes).unwrap()[0] == 0.0);
        let entropy = roi_cross_entropy(Tensor::from_floats([3.0, -200.0, 200.0], &device), &[-1, -1, -1]);
        assert_eq!(host(entropy).unwrap(), [0.0]);
    }

    #[test]
    fn sure_scores_have_finite_losses_and_gradients() {
        let device = Device::flex().autodiff();
        let logits = Tensor::<1>::from_floats([90.0, -90.0, 0.0], &device).require_grad();
        let loss = roi_cross_entropy(logits.clone(), &[0, 1, 1]);
        assert!((host(loss.clone()).unwrap()[0] - (180.0 + 2f32.ln()) / 3.0).abs() < 1e-4);
        let gradient = host(logits.grad(&loss.backward()).unwrap()).unwrap();
        assert!((gradient[0] - 1.0 / 3.0).abs() < 1e-6 && (gradient[1] + 1.0 / 3.0).abs() < 1e-6, "{gradient:?}");
    }

    #[test]
    fn equal_boxes_and_such_turned_round_have_no_corner_loss() {
        let device = Device::flex().autodiff();
        let truth = [[3.0, 1.0, -1.0, 4.0, 2.0, 1.5, 0.4]; 2];
        let mut ours = truth;
        ours[1][6] += std::f32::consts::PI;
        let boxes = rows(ours.as_flattened().to_vec(), [2, 7], &device).require_grad();
        let loss = corner_loss(boxes.clone(), &truth);
        assert!(host(loss.clone()).unwrap().iter().all(|l| l.abs() < 1e-6));
        let gradient = host(boxes.grad(&loss.sum().backward()).unwrap()).unwrap();
        assert!(gradient.iter().all(|g| g.is_finite()));
    }

    /// The gradient of the corner loss with respect to the residuals, against central differences.
    #[test]
    fn gradients_are_those_of_finite_differences() {
        let device = Device::flex().autodiff();
        let rois = [[10.0, 2.0, -1.0, 3.8, 1.7, 1.5, 0.8], [30.0, -5.0, -0.8, 4.1, 1.6, 1.6, -2.0]];
        let truth = [[10.3, 1.8, -0.9, 4.2, 1.6, 1.6, 0.9], [29.5, -4.8, -0.9, 3.9, 1.7, 1.4, 1.2]];
        let start: Vec<f32> = (0..14).map(|i| ((i * 5 % 7) as f32 - 3.0) * 0.05).collect();
        let value = |reg: Tensor<2>| corner_loss(decode_in_regions(reg, &rois), &truth).sum();
        let reg = rows(start.clone(), [2, 7], &device).require_grad();
        let gradient = host(reg.grad(&value(reg.clone()).backward()).unwrap()).unwrap();
        for (i, gradient) in gradient.iter().enumerate() {
            let step = 1e-2;
            let moved = |by: f32| {
                let mut values = start.clone();
                values[i] += by;
                host(value(rows(values, [2, 7], &device))).unwrap()[0]
            };
            let slope = (moved(step) - moved(-step)) / (2.0 * step);
            assert!((slope - gradient).abs() < 2e-3 * (1.0 + slope.abs()), "{i}: {gradient} instead of {slope}");
        }
    }
}
