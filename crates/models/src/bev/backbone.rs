//! The 2D backbone and neck (OpenPCDet: `BaseBEVBackbone`).

use super::config::BackboneConfig;
use super::scatter::PillarCanvas;
use crate::layers::{BatchNorm, ConvBnRelu, Init, Mode, ResampleBnRelu, Resampling};
use burn::module::Module;
use burn::tensor::Tensor;

/// Blocks of 3x3 convolutions, the first of each with a stride, and a transposed convolution (or one with a stride)
/// after each block.
#[derive(Module, Debug)]
pub struct BaseBevBackbone {
    /// The blocks, finest first.
    pub blocks: Vec<Block>,
    /// The transposed convolution of each block, or its convolution with a stride.
    pub deblocks: Vec<ResampleBnRelu>,
}

/// Convolutions at one resolution.
#[derive(Module, Debug)]
pub struct Block {
    /// The first one has the stride.
    pub convs: Vec<ConvBnRelu>,
}

/// Intermediate outputs of the backbone.
#[derive(Clone, Debug)]
pub struct BackboneStages {
    /// Output of each block.
    pub blocks: Vec<Tensor<4>>,
    /// Output of each transposed convolution, all of one size.
    pub deblocks: Vec<Tensor<4>>,
    /// The latter concatenated along the channels.
    pub spatial_features_2d: Tensor<4>,
}

impl BaseBevBackbone {
    /// For a canvas with `inputs` channels.
    pub fn new(inputs: usize, config: &BackboneConfig, init: &Init<'_>) -> Self {
        let norm = |channels| BatchNorm::new(channels, 0.01, 1e-3, init);
        let mut from = inputs;
        let mut blocks = Vec::new();
        let mut deblocks = Vec::new();
        for i in 0..config.layers.len() {
            let filters = config.filters[i];
            let conv = |j: usize, from, stride| {
                let name = format!("backbone_2d.blocks.{i}.{}.weight", 1 + 3 * j);
                ConvBnRelu::new(&name, [from, filters], stride, norm(filters), init)
            };
            let mut convs = vec![conv(0, from, config.strides[i])];
            convs.extend((1..=config.layers[i]).map(|j| conv(j, filters, 1)));
            blocks.push(Block { convs });
            let up = config.upsample_filters[i];
            let resampling = Resampling::of(config.upsample_strides[i]).unwrap_or(Resampling::Up(1));
            let name = format!("backbone_2d.deblocks.{i}.0.weight");
            deblocks.push(ResampleBnRelu::new(&name, [filters, up], resampling, norm(up), init));
            from = filters;
        }
        BaseBevBackbone { blocks, deblocks }
    }

    /// # Shapes
    /// The canvas: `[B, C, H, W]`; `spatial_features_2d`: `[B, sum of the neck's channels, H / s, W / s]`, s =
    /// [`BackboneConfig::output_stride`].
    pub fn forward(&self, canvas: &PillarCanvas, mode: Mode, on_stage: &mut dyn FnMut(&'static str)) -> BackboneStages {
        let first = &self.blocks[0].convs[0];
        let by_kernel = match mode {
            Mode::Train => first.forward_pillars(&canvas.features, &canvas.cells, canvas.shape),
            Mode::Eval => None,
        };
        let mut x = by_kernel.unwrap_or_else(|| {
            let image = canvas.image();
            on_stage("scatter");
            first.forward(image, mode)
        });
        let (mut blocks, mut deblocks) = (Vec::new(), Vec::new());
        for (i, (block, deblock)) in self.blocks.iter().zip(&self.deblocks).enumerate() {
            for conv in &block.convs[usize::from(i == 0)..] {
                x = conv.forward(x, mode);
            }
            blocks.push(x.clone());
            deblocks.push(deblock.forward(x.clone(), mode));
        }
        let spatial_features_2d = Tensor::cat(deblocks.clone(), 1);
        BackboneStages { blocks, deblocks, spatial_features_2d }
    }
}
