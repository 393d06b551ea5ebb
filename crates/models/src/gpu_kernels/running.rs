//! The running statistics of a batch norm.

use super::{UNITS, argument, cubes, unset_like, values};
use burn::backend::{Cube, TensorMetadata};
use burn::tensor::Tensor;
use cubecl::prelude::*;

/// A unit for each channel.
#[cube(launch)]
fn blend_kernel(
    mean: &[f32],
    variance: &[f32],
    of_batch: &[f32],
    variance_of_batch: &[f32],
    new_mean: &mut [f32],
    new_variance: &mut [f32],
    momentum: f32,
    unbiased: f32,
) {
    let i = ABSOLUTE_POS;
    if i < mean.len() {
        new_mean[i] = mean[i] * (1.0 - momentum) + of_batch[i] * momentum;
        new_variance[i] = variance[i] * (1.0 - momentum) + variance_of_batch[i] * unbiased * momentum;
    }
}

/// Running mean and variance after a batch; `None` for tensors that are not on a GPU.
///
/// # Shapes
/// All: `[C]`. `unbiased`: factor of the variance of the batch.
pub fn blend(
    running: [&Tensor<1>; 2],
    of_batch: [&Tensor<1>; 2],
    momentum: f64,
    unbiased: f64,
) -> Option<[Tensor<1>; 2]> {
    let [mean, variance] = running.map(values);
    let [of_batch, variance_of_batch] = of_batch.map(values);
    let (mean, variance, of_batch, variance_of_batch) = (mean?, variance?, of_batch?, variance_of_batch?);
    let outputs = [unset_like(&mean), unset_like(&mean)];
    blend_kernel::launch(
        &mean.client,
        cubes(mean.shape().num_elements()),
        CubeDim::new_1d(UNITS),
        argument(&mean),
        argument(&variance),
        argument(&of_batch),
        argument(&variance_of_batch),
        argument(&outputs[0]),
        argument(&outputs[1]),
        momentum as f32,
        unbiased as f32,
    );
    Some(outputs.map(Tensor::from_primitive::<Cube>))
}
