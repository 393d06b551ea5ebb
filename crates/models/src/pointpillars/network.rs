//! PointPillars from decorated points to predictions (Lang et al. 2019; OpenPCDet: `PointPillar`).

use super::Sample;
use super::backbone::{BackboneStages, BaseBevBackbone};
use super::config::PointPillarsConfig;
use super::head::{AnchorHead, Predictions};
use super::scatter::scatter;
use super::vfe::{PillarRows, PillarVfe};
use crate::config::DetectorConfig;
use crate::layers::{Init, Mode};
use burn::module::Module;
use burn::tensor::{Device, Tensor};

/// The network. Field names are OpenPCDet's.
#[derive(Module, Debug)]
pub struct PointPillars {
    /// Pillar feature net.
    pub vfe: PillarVfe,
    /// 2D backbone and neck.
    pub backbone_2d: BaseBevBackbone,
    /// Head.
    pub dense_head: AnchorHead,
    nx: usize,
    ny: usize,
}

/// The outputs of every stage of a forward pass.
#[derive(Clone, Debug)]
pub struct Stages {
    /// `[P, C]`.
    pub pillar_features: Tensor<2>,
    /// `[B, C, H, W]`.
    pub spatial_features: Tensor<4>,
    /// Blocks and neck.
    pub backbone: BackboneStages,
    /// Predictions of every anchor.
    pub predictions: Predictions,
}

impl PointPillars {
    /// A network with initial weights from `seed`.
    pub fn new(config: &DetectorConfig, net: &PointPillarsConfig, seed: u64, device: &Device) -> Self {
        let init = Init { seed, device };
        let neck = net.backbone.upsample_filters.iter().sum();
        let anchors = net.anchors.iter().map(|a| a.rotations_rad.len()).sum();
        let [nx, ny, _] = net.grid_size(config);
        PointPillars {
            vfe: PillarVfe::new(config.channels + 6, net.vfe_filters, net.pillars.max_points, &init),
            backbone_2d: BaseBevBackbone::new(net.vfe_filters, &net.backbone, &init),
            dense_head: AnchorHead::new(neck, anchors, config.classes.len(), net.head.dir_bins, &init),
            nx,
            ny,
        }
    }

    /// The forward pass of a batch.
    pub fn forward(&self, batch: &[&Sample], mode: Mode) -> Stages {
        let pillar_features = self.vfe.forward(self.pillar_rows(batch), mode);
        let (cells, shape) = self.cells(batch);
        let spatial_features = scatter(pillar_features.clone(), &cells, shape);
        let backbone = self.backbone_2d.forward(spatial_features.clone(), mode);
        let predictions = self.dense_head.forward(backbone.spatial_features_2d.clone());
        Stages { pillar_features, spatial_features, backbone, predictions }
    }

    /// The points of all pillars of a batch, sorted by sample.
    pub fn pillar_rows(&self, batch: &[&Sample]) -> PillarRows {
        let features: Vec<f32> = batch.iter().flat_map(|s| s.features.iter().copied()).collect();
        let num_points: Vec<u32> = batch.iter().flat_map(|s| s.pillars.num_points.iter().copied()).collect();
        PillarRows { features: features.into(), num_points: num_points.into() }
    }

    /// The index of each pillar's cell in `[B, ny, nx]`, and this shape.
    pub fn cells(&self, batch: &[&Sample]) -> (Vec<u32>, [usize; 3]) {
        let cells = batch.iter().enumerate().flat_map(|(b, sample)| {
            let cell = move |&[_, y, x]: &[u32; 3]| ((b * self.ny + y as usize) * self.nx + x as usize) as u32;
            sample.pillars.coords_zyx.iter().map(cell)
        });
        (cells.collect(), [batch.len(), self.ny, self.nx])
    }
}
