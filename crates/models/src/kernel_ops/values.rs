//! Tensors on the CPU device `flex` as slices.

use super::{Input, contiguous, input, slice};
use burn::backend::flex::FlexTensor;
use burn::tensor::Tensor;

/// The values of a tensor without autodiff graph.
#[derive(Clone, Debug)]
pub struct FlexValues(FlexTensor);

impl FlexValues {
    /// `None` if the tensor is on another device or kernels are disabled.
    pub fn of<const D: usize>(tensor: &Tensor<D>) -> Option<Self> {
        match input(tensor)? {
            Input::Plain(tensor) => Some(FlexValues(contiguous(tensor))),
            Input::Tracked(_) => None,
        }
    }

    /// Row-major.
    pub fn as_slice(&self) -> &[f32] {
        slice(&self.0)
    }

    /// Takes the values, without a copy if the tensor is not shared.
    pub fn into_vec(self) -> Vec<f32> {
        let values = self.0.into_data().try_into_vec::<f32>();
        values.expect("f32, as checked before")
    }
}
