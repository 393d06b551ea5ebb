//! The sum of the sigmoid focal loss over all anchors.

use super::norm_relu::{plain, tracked};
use super::units::{end_of, sum_of_cube};
use super::{Primitive, UNITS, argument, cubes, is_plain, unset_like};
use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::NoCheckpointing;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, unary};
use burn::backend::ops::{FloatTensorOps, IntTensorOps};
use burn::backend::tensor::IntTensor;
use burn::backend::{Autodiff, Cube, TensorMetadata};
use burn::tensor::{Shape, Tensor, TensorData};
use cubecl::prelude::*;
use rayon::prelude::*;

/// Most parts that the entries are split into; each is summed by a cube.
const MOST_PARTS: usize = 256;

/// Entries of a part, at least.
const LEAST_OF_PART: usize = 2048;

/// Sigmoid, target and weight of an entry. A label is a byte: k for class k - 1, 0 for none, 255 for an anchor without
/// loss.
#[cube]
fn entry(
    logits: &[f32],
    labels: &[i32],
    weights: &[f32],
    i: usize,
    classes: usize,
    of_frame: usize,
) -> (f32, f32, f32) {
    let row = i / classes;
    let label = (labels[row / 4] >> (8 * (row % 4) as i32)) & 255;
    let target = select(label == (i % classes) as i32 + 1, 1.0f32, 0.0f32);
    let weight = select(label == 255, 0.0f32, weights[row / of_frame]);
    (1.0 / (1.0 + (-logits[i]).exp()), target, weight)
}

/// The cross entropy of a logit.
#[cube]
fn cross_entropy(logit: f32, target: f32) -> f32 {
    max(logit, 0.0f32) - logit * target + (-logit.abs()).exp().log1p()
}

/// Weighted losses, summed over the parts of all entries: a cube for each.
#[cube(launch)]
fn loss_parts(logits: &[f32], labels: &[i32], weights: &[f32], out: &mut [f32], classes: u32, of_frame: u32) {
    let part = CUBE_POS_X as usize;
    let of_part = logits.len().div_ceil(CUBE_COUNT_X as usize);
    let mut i = part * of_part + UNIT_POS as usize;
    let end = end_of(part, of_part, logits.len());
    let mut sum = 0.0f32;
    while i < end {
        let (p, target, weight) = entry(logits, labels, weights, i, classes as usize, of_frame as usize);
        let miss = target + p - target * p * 2.0;
        sum += (0.75 - 0.5 * target) * miss * miss * cross_entropy(logits[i], target) * weight;
        i += CUBE_DIM as usize;
    }
    let sum = sum_of_cube(sum);
    if UNIT_POS == 0 {
        out[part] = sum;
    }
}

/// The sum of at most 256 parts.
#[cube(launch)]
fn total(parts: &[f32], out: &mut [f32]) {
    let mut part = 0.0f32;
    if (UNIT_POS as usize) < parts.len() {
        part = parts[UNIT_POS as usize];
    }
    let sum = sum_of_cube(part);
    if UNIT_POS == 0 {
        out[0] = sum;
    }
}

/// The gradient by each logit.
#[cube(launch)]
fn loss_gradient(
    logits: &[f32],
    labels: &[i32],
    weights: &[f32],
    dy: &[f32],
    out: &mut [f32],
    classes: u32,
    of_frame: u32,
) {
    let i = ABSOLUTE_POS;
    if i < logits.len() {
        let (p, target, weight) = entry(logits, labels, weights, i, classes as usize, of_frame as usize);
        let miss = target + p - target * p * 2.0;
        let by_miss = 2.0 * miss * (1.0 - 2.0 * target) * p * (1.0 - p) * cross_entropy(logits[i], target);
        out[i] = (0.75 - 0.5 * target) * (by_miss + miss * miss * (p - target)) * weight * dy[0];
    }
}

/// The loss with what its gradient needs.
#[derive(Clone, Debug)]
struct Focal {
    logits: Primitive,
    labels: IntTensor<Cube>,
    weights: Primitive,
    classes: u32,
    of_frame: u32,
}

impl Focal {
    fn forward(&self) -> Primitive {
        let values = self.logits.shape().num_elements();
        let parts = (values / LEAST_OF_PART).clamp(1, MOST_PARTS);
        let like =
            |size: usize| Cube::float_empty(Shape::from([size]), &self.logits.device, self.logits.dtype().into());
        let (of_parts, sum) = (like(parts), like(1));
        let [logits, labels, weights, to] = [&self.logits, &self.labels, &self.weights, &of_parts].map(argument);
        let (client, units) = (&self.logits.client, CubeDim::new_1d(UNITS));
        let grid = CubeCount::Static(parts as u32, 1, 1);
        loss_parts::launch(client, grid, units, logits, labels, weights, to, self.classes, self.of_frame);
        total::launch(client, CubeCount::Static(1, 1, 1), units, argument(&of_parts), argument(&sum));
        sum
    }
}

#[derive(Debug)]
struct Loss;

impl Backward<Cube, 1> for Loss {
    type State = Focal;

    fn backward(self, ops: Ops<Focal, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        let focal = ops.state;
        unary::<Cube, _>(ops.parents, ops.node, grads, |dy| {
            let dy = plain(dy);
            let out = unset_like(&focal.logits);
            let inputs = [&focal.logits, &focal.labels, &focal.weights, &dy, &out];
            let [logits, labels, weights, dy, to] = inputs.map(argument);
            let all = cubes(focal.logits.shape().num_elements());
            let (client, units) = (&focal.logits.client, CubeDim::new_1d(UNITS));
            let (classes, of_frame) = (focal.classes, focal.of_frame);
            loss_gradient::launch(client, all, units, logits, labels, weights, dy, to, classes, of_frame);
            out
        });
    }
}

/// The weighted sum over all rows and classes. `None` for logits that are not on a GPU, or without autodiff graph.
///
/// # Shapes
/// `logits`: `[N, C]`; `labels`: N, k for the class with index k - 1, 0 for background, less for a row without loss;
/// `weights`: one for each of as many equal parts of the rows; result `[1]`.
pub fn focal_loss_sum(logits: &Tensor<2>, labels: &[i32], weights: &[f32]) -> Option<Tensor<1>> {
    let [rows, classes] = logits.dims();
    let (logits, node) = logits.clone().try_into_primitive::<Autodiff<Cube, NoCheckpointing>>().ok()?.into_parts();
    let logits = plain(logits);
    if !is_plain(&logits) || classes >= 255 || rows * classes >= 1 << 32 || weights.is_empty() {
        return None;
    }
    // Four labels to a word.
    let byte = |label: i32| if label < 0 { 255 } else { label as u8 };
    let word = |labels: &[i32]| {
        let mut bytes = [0; 4];
        bytes.iter_mut().zip(labels).for_each(|(to, &label)| *to = byte(label));
        i32::from_le_bytes(bytes)
    };
    let words: Vec<i32> = labels.par_chunks(4).map(word).collect();
    let length = words.len();
    let labels = Cube::int_from_data(TensorData::new(words, [length]), &logits.device);
    let weights = Cube::float_from_data(TensorData::new(weights.to_vec(), [weights.len()]), &logits.device);
    let of_frame = (rows / weights.shape()[0]) as u32;
    let focal = Focal { logits, labels, weights, classes: classes as u32, of_frame };
    let loss = focal.forward();
    Some(tracked(Loss, [node], focal, loss))
}
