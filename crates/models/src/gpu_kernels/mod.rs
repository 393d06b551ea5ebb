//! Operations of a training step as single kernels of a GPU, written in CubeCL: products and convolutions, batch norms
//! with a ReLU, the focal loss over anchors, copies and maxima of rows, the norm of the gradients and the optimiser.
//! burn's operations are one kernel each, and on a GPU a step then takes as long as its launches.
//!
//! Each function gives its inputs back as an error, or `None`, for tensors that are not on a GPU or not in single
//! precision. Sums have a fixed order: the same bits in every run on the same device.

mod adam;
mod blocks;
mod focal_loss;
mod maxima;
mod norm_relu;
mod product;
mod rows;
mod running;
mod squares;
mod tensor_cores;
mod units;

pub use adam::adam;
pub(crate) use blocks::sums_of_blocks;
pub(crate) use focal_loss::focal_loss_sum;
pub(crate) use maxima::{gradient_of_maxima, maxima_of_groups};
pub use norm_relu::norm_relu;
pub(crate) use product::{product, sum_of_first};
pub use rows::norm_relu_rows;
pub(crate) use rows::{place_rows, sum_of_rows};
pub(crate) use running::blend;
pub use squares::sums_of_squares;
pub(crate) use tensor_cores::{convolution, convolution_gradient, has_convolutions, round_to_f16};

use burn::backend::autodiff::checkpoint::strategy::NoCheckpointing;
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Cube, TensorMetadata};
use burn::tensor::{DType, Tensor};
use cubecl::prelude::*;

/// Units of a cube in each kernel.
const UNITS: u32 = 256;

type Primitive = FloatTensor<Cube>;

/// Whether the values lie one after the other in single precision.
fn is_plain(tensor: &Primitive) -> bool {
    let shape = tensor.shape();
    let strides = tensor.meta.strides();
    let mut stride = 1;
    tensor.dtype() == DType::F32
        && shape.num_elements() > 0
        && (0..shape.num_dims()).rev().all(|d| {
            let fits = shape[d] == 1 || strides[d] == stride;
            stride *= shape[d];
            fits
        })
}

/// The values of a tensor on a GPU, with or without an autodiff graph.
fn values(tensor: &Tensor<1>) -> Option<Primitive> {
    let tracked = || tensor.clone().try_into_primitive::<Autodiff<Cube, NoCheckpointing>>().ok();
    let values = tensor.clone().try_into_primitive::<Cube>().ok().or_else(|| Some(tracked()?.into_parts().0))?;
    is_plain(&values).then_some(values)
}

/// A tensor of the shape of another one, whose values are not set.
fn unset_like(tensor: &Primitive) -> Primitive {
    Primitive { handle: tensor.client.empty(4 * tensor.shape().num_elements()), ..tensor.clone() }
}

/// The values of a tensor as argument of a kernel.
fn argument(tensor: &Primitive) -> BufferArg {
    // SAFETY: a tensor of single precision without gaps has as many values in its buffer.
    unsafe { BufferArg::from_raw_parts(tensor.handle.clone(), tensor.shape().num_elements()) }
}

/// Cubes for one unit per value.
fn cubes(values: usize) -> CubeCount {
    // A dimension has at most 65,535 cubes.
    let cubes = (values as u32).div_ceil(UNITS);
    let rows = cubes.div_ceil(1 << 15);
    CubeCount::Static(cubes.div_ceil(rows), rows, 1)
}

#[cfg(test)]
mod tests;
