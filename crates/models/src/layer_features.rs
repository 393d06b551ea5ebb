//! The output of one layer for one frame, as a vector.

use crate::ModelError;
use crate::layers::host;
use burn::tensor::Tensor;

/// The output of a layer, averaged over all places (pillars, cells or points).
#[derive(Clone, Debug, PartialEq)]
pub struct LayerFeatures {
    /// Name of the layer, such as `block 1`.
    pub layer: String,
    /// A value a channel.
    pub values: Vec<f32>,
}

impl LayerFeatures {
    /// The mean of `rows` over the places.
    ///
    /// # Shapes
    /// `rows`: `[places, C]`.
    ///
    /// # Errors
    /// Tensors that are not f32.
    pub fn mean(layer: impl Into<String>, rows: Tensor<2>) -> Result<Self, ModelError> {
        Ok(LayerFeatures { layer: layer.into(), values: host(rows.mean_dim(0))? })
    }

    /// The mean of a feature map of one frame over its cells.
    ///
    /// # Shapes
    /// `map`: `[1, C, H, W]`.
    ///
    /// # Errors
    /// Tensors that are not f32.
    pub fn map_mean(layer: impl Into<String>, map: Tensor<4>) -> Result<Self, ModelError> {
        let [_, channels, height, width] = map.dims();
        Self::mean(layer, map.reshape([channels, height * width]).transpose()) // [H * W, C]
    }
}
