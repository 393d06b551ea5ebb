//! CenterPoint from decorated points to the outputs of its heads (Yin et al. 2021; OpenPCDet: `CenterPoint`).

use super::Sample;
use super::config::CenterPointConfig;
use super::head::{CenterHead, HeadOutputs};
use crate::bev::{BevEncoder, BevStages};
use crate::config::DetectorConfig;
use crate::layers::{Init, Mode};
use burn::module::Module;
use burn::tensor::{Device, Tensor};

/// The network.
#[derive(Module, Debug)]
pub struct CenterPoint {
    /// Pillar feature net, 2D backbone and neck.
    pub encoder: BevEncoder,
    /// Heads.
    pub dense_head: CenterHead,
}

/// The outputs of every stage of a forward pass.
#[derive(Clone, Debug)]
pub struct Stages {
    /// Stages in front of the heads.
    pub bev: BevStages,
    /// Output of the shared convolution, `[B, C, H, W]`.
    pub shared: Tensor<4>,
    /// Outputs of each head.
    pub heads: Vec<HeadOutputs>,
}

impl CenterPoint {
    /// A network with initial weights from `seed`.
    pub fn new(config: &DetectorConfig, net: &CenterPointConfig, seed: u64, device: &Device) -> Self {
        let init = Init { seed, device };
        let classes: Vec<usize> = net.heads(config).iter().map(Vec::len).collect();
        CenterPoint {
            encoder: BevEncoder::new(config, net.encoder(), &init),
            dense_head: CenterHead::new(net.backbone.outputs(), &net.head, &classes, &init),
        }
    }

    /// The forward pass of a batch. `on_stage` is called with the name of each stage after it was launched.
    pub fn forward(&self, batch: &[&Sample], mode: Mode, on_stage: &mut dyn FnMut(&'static str)) -> Stages {
        let bev = self.encoder.forward(&Sample::inputs(batch), mode, on_stage);
        let (shared, heads) = self.dense_head.forward(bev.backbone.spatial_features_2d.clone(), mode);
        on_stage("head");
        Stages { bev, shared, heads }
    }
}
