//! PointPillars from decorated points to predictions (Lang et al. 2019; OpenPCDet: `PointPillar`).

use super::Sample;
use super::config::PointPillarsConfig;
use super::head::{AnchorHead, Predictions};
use crate::bev::{BevEncoder, BevStages};
use crate::config::DetectorConfig;
use crate::layers::{Init, Mode};
use burn::module::Module;
use burn::tensor::Device;

/// The network.
#[derive(Module, Debug)]
pub struct PointPillars {
    /// Pillar feature net, 2D backbone and neck.
    pub encoder: BevEncoder,
    /// Head.
    pub dense_head: AnchorHead,
}

/// The outputs of every stage of a forward pass.
#[derive(Clone, Debug)]
pub struct Stages {
    /// Stages in front of the head.
    pub bev: BevStages,
    /// Predictions of every anchor.
    pub predictions: Predictions,
}

impl PointPillars {
    /// A network with initial weights from `seed`.
    pub fn new(config: &DetectorConfig, net: &PointPillarsConfig, seed: u64, device: &Device) -> Self {
        let init = Init { seed, device };
        let anchors = net.anchors.iter().map(|a| a.rotations_rad.len()).sum();
        let (neck, classes) = (net.backbone.outputs(), config.classes.len());
        PointPillars {
            encoder: BevEncoder::new(config, net.encoder(), &init),
            dense_head: AnchorHead::new(neck, anchors, classes, net.head.dir_bins, &init),
        }
    }

    /// The forward pass of a batch.
    pub fn forward(&self, batch: &[&Sample], mode: Mode) -> Stages {
        self.forward_by_stage(batch, mode, &mut |_| ())
    }

    /// The same; `on_stage` is called with the name of each stage after it was launched.
    pub fn forward_by_stage(&self, batch: &[&Sample], mode: Mode, on_stage: &mut dyn FnMut(&'static str)) -> Stages {
        let bev = self.encoder.forward(&Sample::inputs(batch), mode, on_stage);
        let predictions = self.dense_head.forward(bev.backbone.spatial_features_2d.clone());
        on_stage("head");
        Stages { bev, predictions }
    }
}
