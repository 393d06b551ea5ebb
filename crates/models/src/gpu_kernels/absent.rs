//! Operations of a training step as single kernels of a GPU: none in this build, which has no GPU device.

use crate::layers::Moments;
use burn::tensor::{Device, Tensor};
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

/// `None`.
pub(crate) fn focal_loss_sum(_: &Tensor<2>, _: &[i32], _: &[f32]) -> Option<Tensor<1>> {
    None
}

/// `None`.
pub(crate) fn blend(_: [&Tensor<1>; 2], _: [&Tensor<1>; 2], _: f64, _: f64) -> Option<[Tensor<1>; 2]> {
    None
}

/// `None`.
pub fn sums_of_squares(_: &[Tensor<1>]) -> Option<Tensor<1>> {
    None
}

/// No.
pub(crate) fn round_to_f16(_: &Device) -> bool {
    false
}
