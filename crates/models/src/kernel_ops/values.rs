//! Tensors on the CPU device `flex` as slices, for whoever has a kernel for them.

use super::{Input, contiguous, input, slice};
use burn::backend::flex::FlexTensor;
use burn::tensor::Tensor;

/// The values of a tensor without a graph.
#[derive(Clone, Debug)]
pub struct FlexValues(FlexTensor);

impl FlexValues {
    /// `None` where the tensor lives elsewhere, or kernels are not wanted.
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

    /// Without a copy where nobody else holds the tensor.
    pub fn into_vec(self) -> Vec<f32> {
        let values = self.0.into_data().try_into_vec::<f32>();
        values.expect("single precision, as asked before")
    }
}
