//! What every layer of a network makes of a frame, as one vector a layer.

use crate::detector::{Detector, Network, Sample};
use crate::layers::{Mode, host};
use crate::{ModelError, pointpillars, pointrcnn};
use burn::module::Module;
use burn::tensor::Tensor;

/// The mean over all places of what a layer computes.
#[derive(Clone, Debug, PartialEq)]
pub struct LayerFeatures {
    /// The layer, in the order of the pass.
    pub layer: String,
    /// A value a channel.
    pub values: Vec<f32>,
}

impl Detector {
    /// The layers of a pass over one frame, first to last; the last is what the head reads. Empty for a frame without points.
    ///
    /// PointPillars: the pillar feature net (mean over pillars), each block and the neck (mean over cells). PointRCNN: each level of set
    /// abstraction and of feature propagation (mean over points).
    ///
    /// # Errors
    /// A sample of another kind of network.
    pub fn layer_features(&self, sample: &Sample) -> Result<Vec<LayerFeatures>, ModelError> {
        if sample.is_empty() {
            return Ok(Vec::new());
        }
        match (self.network.valid(), sample) {
            (Network::PointPillars(network), Sample::PointPillars(sample)) => of_pillars(&network, sample),
            (Network::PointRcnn(network), Sample::PointRcnn(sample)) => of_points(&network, sample),
            _ => Err(ModelError::Tensor("the sample was prepared for another kind of network".into())),
        }
    }
}

fn of_pillars(
    network: &pointpillars::PointPillars,
    sample: &pointpillars::Sample,
) -> Result<Vec<LayerFeatures>, ModelError> {
    let stages = network.forward(&[sample], Mode::Eval);
    let mut layers = vec![layer("pillar features".into(), stages.pillar_features)?];
    for (i, block) in stages.backbone.blocks.into_iter().enumerate() {
        layers.push(layer(format!("block {}", i + 1), cells(block))?);
    }
    layers.push(layer("neck".into(), cells(stages.backbone.spatial_features_2d))?);
    Ok(layers)
}

fn of_points(network: &pointrcnn::PointRcnn, sample: &pointrcnn::Sample) -> Result<Vec<LayerFeatures>, ModelError> {
    let backbone = network.points(&[sample], Mode::Eval).backbone;
    let mut layers = Vec::new();
    for (i, level) in backbone.set_abstraction.into_iter().enumerate() {
        layers.push(layer(format!("set abstraction {}", i + 1), level)?);
    }
    for (i, level) in backbone.propagation.into_iter().enumerate().rev() {
        layers.push(layer(format!("propagation {}", i + 1), level)?);
    }
    Ok(layers)
}

/// `[1, C, H, W]` to `[H * W, C]`.
fn cells(map: Tensor<4>) -> Tensor<2> {
    let [_, channels, height, width] = map.dims();
    map.reshape([channels, height * width]).transpose() // [H * W, C]
}

fn layer(layer: String, rows: Tensor<2>) -> Result<LayerFeatures, ModelError> {
    Ok(LayerFeatures { layer, values: host(rows.mean_dim(0))? })
}
