//! PointRCNN from points to predictions of both stages (Shi et al. 2019; OpenPCDet: `PointRCNN`).

use super::Sample;
use super::backbone::{BackboneStages, PointNet2Msg};
use super::config::PointRcnnConfig;
use super::hierarchy::Hierarchy;
use super::point_head::{PointHead, PointPredictions};
use super::roi_head::RoiHead;
use crate::config::DetectorConfig;
use crate::layers::{Init, Mode};
use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};

/// The network. Field names are OpenPCDet's.
#[derive(Module, Debug)]
pub struct PointRcnn {
    /// PointNet++.
    pub backbone_3d: PointNet2Msg,
    /// The head of the first stage.
    pub point_head: PointHead,
    /// The second stage.
    pub roi_head: RoiHead,
}

/// The outputs of the first stage.
#[derive(Clone, Debug)]
pub struct PointStages {
    /// Set abstraction and feature propagation.
    pub backbone: BackboneStages,
    /// Predictions of every point.
    pub predictions: PointPredictions,
}

impl PointStages {
    /// Features of every point, `[B * N, C]`.
    pub fn point_features(&self) -> Tensor<2> {
        self.backbone.propagation[0].clone()
    }
}

impl PointRcnn {
    /// A network with initial weights from `seed`.
    pub fn new(config: &DetectorConfig, net: &PointRcnnConfig, seed: u64, device: &Device) -> Self {
        let init = Init { seed, device };
        let features = net.propagation[0][net.propagation[0].len() - 1];
        PointRcnn {
            backbone_3d: PointNet2Msg::new(config.channels - 3, net, &init),
            point_head: PointHead::new(features, config.classes.len(), &net.point_head, &init),
            roi_head: RoiHead::new(features, &net.roi_head, &init),
        }
    }

    /// The first stage of a batch; no cloud of it may be empty.
    pub fn points(&self, batch: &[&Sample], mode: Mode) -> PointStages {
        let device = self.device();
        let features: Vec<f32> = batch.iter().flat_map(|s| s.features.iter().copied()).collect();
        let points: usize = batch.iter().map(|s| s.points.len()).sum();
        let width = features.len() / points.max(1);
        let features = (width > 0).then(|| Tensor::from_data(TensorData::new(features, [points, width]), &device));
        let clouds: Vec<&Hierarchy> = batch.iter().map(|s| &s.hierarchy).collect();
        let backbone = self.backbone_3d.forward(features, &clouds, &device, mode);
        let predictions = self.point_head.forward(backbone.propagation[0].clone(), mode);
        PointStages { backbone, predictions }
    }

    /// The device of the weights.
    pub fn device(&self) -> Device {
        self.point_head.cls_layers.last.bias.val().device()
    }
}
