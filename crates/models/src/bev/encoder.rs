//! The network in front of the head: pillar feature net, scatter, 2D backbone.

use super::backbone::{BackboneStages, BaseBevBackbone};
use super::config::{BackboneConfig, PillarsConfig};
use super::input::PillarInput;
use super::scatter::PillarCanvas;
use super::vfe::{PillarRows, PillarVfe};
use crate::config::DetectorConfig;
use crate::layers::{Init, Mode, host};
use crate::limits::{MOST_FILTERS, MOST_LAYERS, at_most};
use crate::{LayerFeatures, ModelError};
use burn::module::Module;

/// From pillars to the feature map that the head reads. Field names are OpenPCDet's.
#[derive(Module, Debug)]
pub struct BevEncoder {
    /// Pillar feature net.
    pub vfe: PillarVfe,
    /// 2D backbone and neck.
    pub backbone_2d: BaseBevBackbone,
    nx: usize,
    ny: usize,
}

/// The sizes of a [`BevEncoder`].
#[derive(Clone, Copy, Debug)]
pub struct EncoderConfig<'a> {
    /// Pillars.
    pub pillars: &'a PillarsConfig,
    /// Channels of the layers of the pillar feature net.
    pub vfe_filters: &'a [usize],
    /// 2D backbone and neck.
    pub backbone: &'a BackboneConfig,
}

/// The outputs of every stage of the encoder.
#[derive(Clone, Debug)]
pub struct BevStages {
    /// Features of the pillars, `[P, C]`, and their places.
    pub canvas: PillarCanvas,
    /// Blocks and neck.
    pub backbone: BackboneStages,
}

impl EncoderConfig<'_> {
    /// Whether the sizes fit together and to the detector's range; the message names the key.
    pub fn check(&self, detector: &DetectorConfig) -> Result<(), String> {
        self.pillars.check(detector)?;
        let [nx, ny, _] = self.pillars.grid_size(detector);
        self.backbone.check([nx, ny])?;
        let (last, hidden) = self.vfe_filters.split_last().ok_or("network.vfe_filters needs at least one layer")?;
        if *last == 0 || hidden.contains(&0) {
            return Err("network.vfe_filters must be above 0".into());
        }
        at_most(MOST_LAYERS, &[("the number of network.vfe_filters", &[self.vfe_filters.len()])])?;
        at_most(MOST_FILTERS, &[("network.vfe_filters", self.vfe_filters)])?;
        match hidden.iter().find(|filters| *filters % 2 != 0) {
            Some(odd) => Err(format!(
                "network.vfe_filters: {odd} is odd; all layers but the last give half of their channels to the \
                 pillar's maximum"
            )),
            None => Ok(()),
        }
    }

    /// Height and width of the feature map.
    pub fn map(&self, detector: &DetectorConfig) -> [usize; 2] {
        let ([nx, ny, _], stride) = (self.pillars.grid_size(detector), self.backbone.output_stride());
        [ny / stride, nx / stride]
    }
}

impl BevEncoder {
    /// An encoder with initial weights.
    pub fn new(detector: &DetectorConfig, net: EncoderConfig<'_>, init: &Init<'_>) -> Self {
        let [nx, ny, _] = net.pillars.grid_size(detector);
        let channels = net.vfe_filters.last().copied().unwrap_or(0);
        BevEncoder {
            vfe: PillarVfe::new(detector.channels + 6, net.vfe_filters, net.pillars.max_points, init),
            backbone_2d: BaseBevBackbone::new(channels, net.backbone, init),
            nx,
            ny,
        }
    }

    /// The forward pass of a batch. `on_stage` is called with the name of each stage after it was launched.
    pub fn forward(&self, batch: &[&PillarInput], mode: Mode, on_stage: &mut dyn FnMut(&'static str)) -> BevStages {
        let features = self.vfe.forward(self.pillar_rows(batch), mode);
        on_stage("encoder");
        let (cells, shape) = self.cells(batch);
        let canvas = PillarCanvas { features, cells, shape };
        let backbone = self.backbone_2d.forward(&canvas, mode, on_stage);
        on_stage("backbone");
        BevStages { canvas, backbone }
    }

    /// The points of all pillars of a batch, sorted by sample.
    fn pillar_rows(&self, batch: &[&PillarInput]) -> PillarRows {
        let features: Vec<f32> = batch.iter().flat_map(|s| s.features.iter().copied()).collect();
        let num_points: Vec<u32> = batch.iter().flat_map(|s| s.pillars.num_points.iter().copied()).collect();
        PillarRows { features: features.into(), num_points: num_points.into() }
    }

    /// The index of each pillar's cell in `[B, ny, nx]`, and this shape.
    fn cells(&self, batch: &[&PillarInput]) -> (Vec<u32>, [usize; 3]) {
        let cells = batch.iter().enumerate().flat_map(|(b, sample)| {
            let cell = move |&[_, y, x]: &[u32; 3]| ((b * self.ny + y as usize) * self.nx + x as usize) as u32;
            sample.pillars.coords_zyx.iter().map(cell)
        });
        (cells.collect(), [batch.len(), self.ny, self.nx])
    }

    /// The neck's output, mean over the cells of the map: one vector a frame.
    ///
    /// # Errors
    /// Tensors that are not f32.
    pub fn frame_features(&self, batch: &[&PillarInput]) -> Result<Vec<Vec<f32>>, ModelError> {
        let map = self.forward(batch, Mode::Eval, &mut |_| ()).backbone.spatial_features_2d;
        let [frames, channels, height, width] = map.dims();
        let mean = map.reshape([frames, channels, height * width]).mean_dim(2); // [B, C, 1]
        Ok(host(mean)?.chunks_exact(channels).map(<[f32]>::to_vec).collect())
    }

    /// The pillar feature net (mean over pillars), each block and the neck (mean over cells) of one frame.
    ///
    /// # Errors
    /// Tensors that are not f32.
    pub fn layer_features(&self, sample: &PillarInput) -> Result<Vec<LayerFeatures>, ModelError> {
        let stages = self.forward(&[sample], Mode::Eval, &mut |_| ());
        let mut layers = vec![LayerFeatures::mean("pillar features", stages.canvas.features)?];
        for (i, block) in stages.backbone.blocks.into_iter().enumerate() {
            layers.push(LayerFeatures::map_mean(format!("block {}", i + 1), block)?);
        }
        layers.push(LayerFeatures::map_mean("neck", stages.backbone.spatial_features_2d)?);
        Ok(layers)
    }
}

/// OpenPCDet's name of a tensor of the encoder; a path outside of it stays as it is.
pub fn tensor_name(path: &[&str]) -> String {
    match path {
        ["vfe", "pfn_layers", i, "weight"] => format!("vfe.pfn_layers.{i}.linear.weight"),
        ["backbone_2d", "blocks", i, "convs", j, rest @ ..] => {
            let first = 1 + 3 * j.parse::<usize>().unwrap_or(0);
            match rest {
                ["norm", name] => format!("backbone_2d.blocks.{i}.{}.{name}", first + 1),
                _ => format!("backbone_2d.blocks.{i}.{first}.{}", rest.join(".")),
            }
        }
        ["backbone_2d", "deblocks", i, "norm", name] => format!("backbone_2d.deblocks.{i}.1.{name}"),
        ["backbone_2d", "deblocks", i, name] => format!("backbone_2d.deblocks.{i}.0.{name}"),
        _ => path.join("."),
    }
}
