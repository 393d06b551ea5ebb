//! The running statistics of a batch norm, and sums of squares of many tensors.

use super::units::{end_of, sum_of_cube};
use super::{Primitive, UNITS, argument, cubes, is_plain, unset_like};
use burn::backend::autodiff::checkpoint::strategy::NoCheckpointing;
use burn::backend::ops::FloatTensorOps;
use burn::backend::{Autodiff, Cube, TensorMetadata};
use burn::tensor::{Shape, Tensor};
use cubecl::prelude::*;

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

/// The values of a tensor on a GPU, with or without an autodiff graph.
fn values(tensor: &Tensor<1>) -> Option<Primitive> {
    let tracked = || tensor.clone().try_into_primitive::<Autodiff<Cube, NoCheckpointing>>().ok();
    let values = tensor.clone().try_into_primitive::<Cube>().ok().or_else(|| Some(tracked()?.into_parts().0))?;
    is_plain(&values).then_some(values)
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

/// Parts that a tensor is split into, at most; each is summed by a cube.
const PARTS: usize = 32;

/// Values of a part, at least.
const LEAST_OF_PART: usize = 4096;

/// Squares of a tensor, summed over its parts; the sums of all tensors lie in `out`, `slot` says where.
#[cube(launch)]
fn square_parts(x: &[f32], out: &mut [f32], slot: u32) {
    let part = CUBE_POS_X as usize;
    let of_part = x.len().div_ceil(CUBE_COUNT_X as usize);
    let mut i = part * of_part + UNIT_POS as usize;
    let end = end_of(part, of_part, x.len());
    let mut sum = 0.0f32;
    while i < end {
        sum += x[i] * x[i];
        i += CUBE_DIM as usize;
    }
    let sum = sum_of_cube(sum);
    if UNIT_POS == 0 {
        out[slot as usize * PARTS + part] = sum;
    }
}

/// The sum of the parts of each tensor.
#[cube(launch)]
fn square_sums(parts: &[f32], out: &mut [f32]) {
    let i = ABSOLUTE_POS;
    if i < out.len() {
        let mut sum = 0.0f32;
        for part in 0..PARTS {
            sum += parts[i * PARTS + part];
        }
        out[i] = sum;
    }
}

/// The sum of the squares of each tensor; `None` if one is not on a GPU.
///
/// # Shapes
/// N tensors of any length but 0; result `[N]`.
pub fn sums_of_squares(tensors: &[Tensor<1>]) -> Option<Tensor<1>> {
    let tensors = tensors.iter().map(values).collect::<Option<Vec<_>>>()?;
    let first = tensors.first()?;
    let (client, units) = (&first.client, CubeDim::new_1d(UNITS));
    let parts = Cube::float_zeros(Shape::from([tensors.len() * PARTS]), &first.device, first.dtype().into());
    let sums = Cube::float_empty(Shape::from([tensors.len()]), &first.device, first.dtype().into());
    for (slot, tensor) in tensors.iter().enumerate() {
        let cubes = tensor.shape().num_elements().div_ceil(LEAST_OF_PART).min(PARTS);
        let grid = CubeCount::Static(cubes as u32, 1, 1);
        square_parts::launch(client, grid, units, argument(tensor), argument(&parts), slot as u32);
    }
    square_sums::launch(client, cubes(tensors.len()), units, argument(&parts), argument(&sums));
    Some(Tensor::from_primitive::<Cube>(sums))
}
