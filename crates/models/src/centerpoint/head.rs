//! The heads (OpenPCDet: `CenterHead`, `SeparateHead`).

use super::config::{BranchLayersConfig, CenterHeadConfig};
use crate::layers::{BatchNorm, Conv, ConvBnRelu, Init, Mode};
use burn::module::Module;
use burn::tensor::Tensor;

/// Initial bias of the heat maps: a probability of 0.1.
const HEAT_MAP_BIAS: f32 = -2.19;

/// A shared convolution and the heads.
#[derive(Module, Debug)]
pub struct CenterHead {
    /// In front of all heads.
    pub shared_conv: ConvBnRelu,
    /// One for each group of classes.
    pub heads_list: Vec<SeparateHead>,
}

/// The branches of one head.
#[derive(Module, Debug)]
pub struct SeparateHead {
    /// Offset of the centre, 2 channels.
    pub center: Branch,
    /// Height of the centre, 1 channel.
    pub center_z: Branch,
    /// Logarithms of the sizes, 3 channels.
    pub dim: Branch,
    /// Cosine and sine of the heading, 2 channels.
    pub rot: Branch,
    /// Logits of the heat maps, one channel a class.
    pub hm: Branch,
}

/// Convolutions, numbered as in the reference.
#[derive(Module, Debug)]
pub struct Branch {
    /// All but the last are [`BranchLayer::Hidden`].
    pub layers: Vec<BranchLayer>,
}

/// A convolution of a branch.
#[derive(Module, Debug)]
#[expect(clippy::large_enum_variant, reason = "a network has a few dozen of them")]
pub enum BranchLayer {
    /// With batch norm and ReLU.
    Hidden(ConvBnRelu),
    /// The output.
    Output(Conv),
}

/// Outputs of one head.
#[derive(Clone, Debug)]
pub struct HeadOutputs {
    /// Offset of the centre in cells, `[B, 2, H, W]`.
    pub center: Tensor<4>,
    /// Height of the centre, m, `[B, 1, H, W]`.
    pub center_z: Tensor<4>,
    /// Logarithms of the sizes, `[B, 3, H, W]`.
    pub dim: Tensor<4>,
    /// Cosine and sine of the heading, `[B, 2, H, W]`.
    pub rot: Tensor<4>,
    /// Logits of the heat maps, `[B, classes, H, W]`.
    pub hm: Tensor<4>,
}

impl HeadOutputs {
    /// The branches of the box code in its order.
    pub fn code(&self) -> [&Tensor<4>; 4] {
        [&self.center, &self.center_z, &self.dim, &self.rot]
    }
}

impl CenterHead {
    /// For `inputs` channels and heads with these numbers of classes.
    pub fn new(inputs: usize, config: &CenterHeadConfig, classes: &[usize], init: &Init<'_>) -> Self {
        let shared_conv = hidden("dense_head.shared_conv.0", [inputs, config.filters], config.bias_before_norm, init);
        let head = |(h, &classes)| SeparateHead::new(&format!("dense_head.heads_list.{h}"), config, classes, init);
        CenterHead { shared_conv, heads_list: classes.iter().enumerate().map(head).collect() }
    }

    /// The output of the shared convolution, and that of each head.
    ///
    /// # Shapes
    /// `x`: `[B, C, H, W]`; first result `[B, filters, H, W]`.
    pub fn forward(&self, x: Tensor<4>, mode: Mode) -> (Tensor<4>, Vec<HeadOutputs>) {
        let shared = self.shared_conv.forward(x, mode);
        let heads = self.heads_list.iter().map(|head| head.forward(&shared, mode)).collect();
        (shared, heads)
    }
}

impl SeparateHead {
    /// # Shapes
    /// `shared`: `[B, filters, H, W]`.
    fn forward(&self, shared: &Tensor<4>, mode: Mode) -> HeadOutputs {
        let branches = [&self.center, &self.center_z, &self.dim, &self.rot, &self.hm];
        let [center, center_z, dim, rot, hm] = Branch::forward_together(branches, shared, mode)
            .unwrap_or_else(|| branches.map(|branch| branch.forward(shared.clone(), mode)));
        HeadOutputs { center, center_z, dim, rot, hm }
    }

    fn new(name: &str, config: &CenterHeadConfig, classes: usize, init: &Init<'_>) -> Self {
        let BranchLayersConfig { hm, center, center_z, dim, rot } = config.layers;
        let branch =
            |part: &str, outputs, layers| Branch::new(&format!("{name}.{part}"), outputs, layers, config, init);
        let mut head = SeparateHead {
            center: branch("center", 2, center),
            center_z: branch("center_z", 1, center_z),
            dim: branch("dim", 3, dim),
            rot: branch("rot", 2, rot),
            hm: branch("hm", classes, hm),
        };
        for (part, branch) in [
            ("center", &mut head.center),
            ("center_z", &mut head.center_z),
            ("dim", &mut head.dim),
            ("rot", &mut head.rot),
        ] {
            branch.kaiming(&format!("{name}.{part}"), init);
        }
        if let Some(BranchLayer::Output(conv)) = head.hm.layers.last_mut() {
            conv.bias = init.constant([classes], HEAT_MAP_BIAS);
        }
        head
    }
}

impl Branch {
    fn new(name: &str, outputs: usize, layers: usize, config: &CenterHeadConfig, init: &Init<'_>) -> Self {
        let filters = config.filters;
        let last = layers.saturating_sub(1);
        let hidden = (0..last).map(|k| {
            BranchLayer::Hidden(hidden(&format!("{name}.{k}.0"), [filters; 2], config.bias_before_norm, init))
        });
        let output = BranchLayer::Output(Conv::new(&format!("{name}.{last}"), [filters, outputs], init));
        Branch { layers: hidden.chain([output]).collect() }
    }

    /// Kaiming's normal weights (He et al. 2015) and biases of zero.
    fn kaiming(&mut self, name: &str, init: &Init<'_>) {
        for (k, layer) in self.layers.iter_mut().enumerate() {
            let (name, weight, bias) = match layer {
                BranchLayer::Hidden(conv) => (format!("{name}.{k}.0.weight"), &mut conv.weight, conv.bias.as_mut()),
                BranchLayer::Output(conv) => (format!("{name}.{k}.weight"), &mut conv.weight, Some(&mut conv.bias)),
            };
            let shape = weight.dims();
            *weight = init.normal(&name, shape, (2.0 / (shape[1] * 9) as f32).sqrt());
            if let Some(bias) = bias {
                *bias = init.constant([shape[0]], 0.0);
            }
        }
    }

    /// Branches of two layers, as published, as two convolutions for all of them; `None` for other branches, or without
    /// a kernel.
    ///
    /// # Shapes
    /// `x`: `[B, filters, H, W]`; results `[B, outputs, H, W]`.
    fn forward_together<const N: usize>(branches: [&Branch; N], x: &Tensor<4>, mode: Mode) -> Option<[Tensor<4>; N]> {
        let (mut hidden, mut outputs) = (Vec::with_capacity(N), Vec::with_capacity(N));
        for branch in branches {
            let [BranchLayer::Hidden(first), BranchLayer::Output(last)] = branch.layers.as_slice() else { return None };
            hidden.push(first);
            outputs.push(last);
        }
        let y = Conv::forward_together(&outputs, ConvBnRelu::forward_together(&hidden, x, mode)?);
        let mut from = 0;
        Some(std::array::from_fn(|k| {
            let channels = outputs[k].bias.dims()[0];
            from += channels;
            y.clone().narrow(1, from - channels, channels)
        }))
    }

    /// # Shapes
    /// `x`: `[B, filters, H, W]`; result `[B, outputs, H, W]`.
    fn forward(&self, x: Tensor<4>, mode: Mode) -> Tensor<4> {
        self.layers.iter().fold(x, |x, layer| match layer {
            BranchLayer::Hidden(conv) => conv.forward(x, mode),
            BranchLayer::Output(conv) => conv.forward(x),
        })
    }
}

/// A convolution with batch norm and ReLU; its norm has PyTorch's default constants, unlike those of the backbone.
fn hidden(name: &str, channels: [usize; 2], bias: bool, init: &Init<'_>) -> ConvBnRelu {
    let norm = BatchNorm::new(channels[1], 0.1, 1e-5, init);
    let mut conv = ConvBnRelu::new(&format!("{name}.weight"), channels, 1, norm, init);
    conv.bias = bias.then(|| init.uniform(&format!("{name}.bias"), [channels[1]], channels[0] * 9));
    conv
}
