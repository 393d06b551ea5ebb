//! Sums of the squares of many tensors: the norm of the gradients.

use super::units::{end_of, sum_of_cube};
use super::{UNITS, argument, sum_of_first, values};
use burn::backend::ops::FloatTensorOps;
use burn::backend::{Cube, TensorMetadata};
use burn::tensor::{Shape, Tensor};
use cubecl::prelude::*;

/// Parts that a tensor is split into, at most; each is summed by a cube.
const PARTS: usize = 32;

/// Values of a part, at least.
const LEAST_OF_PART: usize = 4096;

/// Squares of a tensor, summed over its parts. `out`: those of all tensors, `[PARTS, tensors]`.
#[cube(launch)]
fn square_parts(x: &[f32], out: &mut [f32], slot: u32, tensors: u32) {
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
        out[part * tensors as usize + slot as usize] = sum;
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
    let parts = Cube::float_zeros(Shape::from([PARTS, tensors.len()]), &first.device, first.dtype().into());
    for (slot, tensor) in tensors.iter().enumerate() {
        let cubes = tensor.shape().num_elements().div_ceil(LEAST_OF_PART).min(PARTS);
        let grid = CubeCount::Static(cubes as u32, 1, 1);
        square_parts::launch(
            client,
            grid,
            units,
            argument(tensor),
            argument(&parts),
            slot as u32,
            tensors.len() as u32,
        );
    }
    let sums = sum_of_first(&parts)?;
    Some(Tensor::from_primitive::<Cube>(Cube::float_reshape(sums, Shape::from([tensors.len()]))))
}
