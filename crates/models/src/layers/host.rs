//! Transfer of tensors to the host.

use crate::ModelError;
use burn::tensor::Tensor;

/// The values of a float tensor, row-major.
///
/// # Errors
/// A tensor that is not f32.
pub fn host<const D: usize>(tensor: Tensor<D>) -> Result<Vec<f32>, ModelError> {
    tensor.into_data().try_into_vec::<f32>().map_err(|e| ModelError::Tensor(format!("{e:?}")))
}
