//! Operations of a training step as single kernels of a GPU: none in this build, which has no GPU device.

use crate::layers::Moments;
use burn::tensor::Tensor;
use kernels::AdamStep;

/// The inputs.
#[expect(clippy::result_large_err, reason = "the tensors are returned if there is no kernel")]
pub fn adam(tensors: [Tensor<1>; 4], _: &AdamStep) -> Result<[Tensor<1>; 3], [Tensor<1>; 4]> {
    Err(tensors)
}

/// `None`.
pub fn norm_relu<const D: usize>(
    _: &Tensor<D>,
    _: &Tensor<1>,
    _: &Tensor<1>,
    _: f64,
    _: bool,
) -> Option<(Tensor<D>, Moments)> {
    None
}

/// `None`.
pub fn norm_relu_rows(
    _: &Tensor<2>,
    _: (&Tensor<1>, &Tensor<1>),
    _: (&Tensor<1>, usize),
    _: f64,
    _: bool,
) -> Option<(Tensor<2>, Moments)> {
    None
}
