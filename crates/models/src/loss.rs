//! Losses of the detectors, as OpenPCDet computes them.

use crate::{gpu_kernels, kernel_ops};
use burn::tensor::activation::{log_softmax, sigmoid};
use burn::tensor::{Tensor, TensorData};

/// Rows of objects are filled up to a multiple of this by rows without loss. On a GPU burn compiles its kernels for how
/// many values divide evenly, and the number of objects is another one in each step.
const OBJECTS: usize = 16;

/// The number of rows for `objects` objects.
pub fn filled_up(objects: usize) -> usize {
    objects.next_multiple_of(OBJECTS)
}

/// Sigmoid focal loss with alpha 0.25 and gamma 2, one value per entry.
///
/// # Shapes
/// `logits`, `target` (0 or 1) and the result: `[N, C]`.
pub fn sigmoid_focal(logits: Tensor<2>, target: Tensor<2>) -> Tensor<2> {
    let p = sigmoid(logits.clone());
    let alpha = target.clone() * -0.5 + 0.75; // 0.25 where the target is 1, 0.75 where it is 0
    let miss = target.clone() + p.clone() - target.clone() * p * 2.0; // t (1 - p) + (1 - t) p
    let cross_entropy = logits.clone().clamp_min(0.0) - logits.clone() * target + (-logits.abs()).exp().log1p();
    alpha * miss.clone() * miss * cross_entropy
}

/// The weighted sum of [`sigmoid_focal`] over rows and classes, as one operation if there is a kernel.
///
/// # Shapes
/// `logits`: `[N, C]`; `labels`: N, k for the class with index k - 1, 0 for background, less for a row without loss;
/// `frame_weights`: one for each of as many equal parts of the rows; result `[1]`.
pub fn sigmoid_focal_sum(logits: Tensor<2>, labels: &[i32], frame_weights: &[f32]) -> Tensor<1> {
    let ([rows, classes], device) = (logits.dims(), logits.device());
    if let Some(loss) = gpu_kernels::focal_loss_sum(&logits, labels, frame_weights) {
        return loss;
    }
    let of_frame = (rows / frame_weights.len().max(1)).max(1);
    let of_label = |weight: f32| move |&label: &i32| if label < 0 { 0.0 } else { weight };
    let frames = labels.chunks(of_frame).zip(frame_weights);
    let weights: Vec<f32> = frames.flat_map(|(labels, &weight)| labels.iter().map(of_label(weight))).collect();
    kernel_ops::focal_loss_sum(&logits, labels, &weights).unwrap_or_else(|| {
        let mut one_hot = vec![0f32; rows * classes];
        for (row, &label) in labels.iter().enumerate().filter(|(_, label)| **label > 0) {
            one_hot[row * classes + label as usize - 1] = 1.0;
        }
        let tensor = |values, shape: [usize; 2]| Tensor::<2>::from_data(TensorData::new(values, shape), &device);
        (sigmoid_focal(logits, tensor(one_hot, [rows, classes])) * tensor(weights, [rows, 1])).sum()
    })
}

/// `scale` times the sum over all cells of the focal loss of heat maps: with p the sigmoid of the logit, clamped to
/// [1e-4, 1 - 1e-4], `-(1 - p)^2 ln p` where the heat map is 1, else `-(1 - h)^4 p^2 ln(1 - p)`.
///
/// # Shapes
/// `logits`: `[B, C, H, W]`; `heat_map`: as many values, row-major; result `[1]`.
pub fn gaussian_focal_sum(logits: Tensor<4>, heat_map: Vec<f32>, scale: f32) -> Tensor<1> {
    kernel_ops::gaussian_focal_loss(&logits, &heat_map, scale).unwrap_or_else(|| {
        let heat_map = Tensor::<4>::from_data(TensorData::new(heat_map, logits.dims()), &logits.device());
        let p = sigmoid(logits).clamp(1e-4, 1.0 - 1e-4);
        let q = -p.clone() + 1.0;
        let far = (-heat_map.clone() + 1.0).powi_scalar(4);
        let peak = p.clone().log() * q.clone().powi_scalar(2);
        let other = q.log() * p.powi_scalar(2) * far;
        let is_peak = heat_map.equal_elem(1.0);
        other.mask_where(is_peak, peak).sum() * -scale
    })
}

/// Smooth L1 of a difference: quadratic below `beta`, linear above.
///
/// # Shapes
/// Any; the result has the same.
pub fn smooth_l1<const D: usize>(difference: Tensor<D>, beta: f64) -> Tensor<D> {
    let n = difference.abs();
    let small = n.clone().powi_scalar(2) * (0.5 / beta);
    let large = n.clone() - 0.5 * beta;
    let is_small = n.lower_elem(beta);
    large.mask_where(is_small, small)
}

/// Residuals whose seventh value is replaced by `sin p cos t` and `cos p sin t`, so that their difference is the sine
/// of the heading difference.
///
/// # Shapes
/// `pred`, `target` and both results: `[N, 7]`.
pub fn add_sin_difference(pred: Tensor<2>, target: Tensor<2>) -> (Tensor<2>, Tensor<2>) {
    let (heading, truth) = (pred.clone().narrow(1, 6, 1), target.clone().narrow(1, 6, 1)); // [N, 1]
    let ours = heading.clone().sin() * truth.clone().cos();
    let theirs = heading.cos() * truth.sin();
    (Tensor::cat(vec![pred.narrow(1, 0, 6), ours], 1), Tensor::cat(vec![target.narrow(1, 0, 6), theirs], 1))
}

/// Cross entropy of each row.
///
/// # Shapes
/// `logits`: `[N, K]`; `target`: N columns; result `[N]`.
pub fn cross_entropy(logits: Tensor<2>, target: &[usize]) -> Tensor<1> {
    let ([n, classes], device) = (logits.dims(), logits.device());
    let mut one_hot = vec![0f32; n * classes];
    target.iter().enumerate().for_each(|(row, column)| one_hot[row * classes + column] = 1.0);
    let one_hot = Tensor::<2>::from_data(TensorData::new(one_hot, [n, classes]), &device);
    -(log_softmax(logits, 1) * one_hot).sum_dim(1).reshape([n])
}
