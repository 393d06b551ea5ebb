//! Convolutions with batch norm and ReLU.

use super::precision::multiply;
use super::{BatchNorm, Init, Mode, host};
use crate::kernel_ops::{conv3x3, folded_conv3x3, pillar_conv, pixel_heads};
use crate::products;
use burn::module::{Module, Param};
use burn::tensor::Tensor;
use burn::tensor::module::conv2d;
use burn::tensor::ops::ConvOptions;
use kernels::Folded;

/// 3x3 convolution with padding 1, batch normalisation, ReLU.
///
/// A bias before a batch norm changes only the running mean: the norm subtracts it again. It is therefore never added
/// to the image in training, and it has no gradient.
#[derive(Module, Debug)]
pub struct ConvBnRelu {
    /// `[C_out, C_in, 3, 3]`.
    pub weight: Param<Tensor<4>>,
    /// `[C_out]`, if the convolution has a bias.
    pub bias: Option<Param<Tensor<1>>>,
    /// The batch norm after the convolution.
    pub norm: BatchNorm,
    stride: usize,
}

impl ConvBnRelu {
    /// A layer of the given channels and stride, without bias; `name` keys its initial weights.
    pub fn new(name: &str, channels: [usize; 2], stride: usize, norm: BatchNorm, init: &Init<'_>) -> Self {
        let [input, output] = channels;
        ConvBnRelu { weight: init.uniform(name, [output, input, 3, 3], input * 9), bias: None, norm, stride }
    }

    /// # Shapes
    /// `x`: `[B, C_in, H, W]`; result `[B, C_out, H / stride, W / stride]`.
    pub fn forward(&self, x: Tensor<4>, mode: Mode) -> Tensor<4> {
        let (weight, stride) = (self.weight.val(), self.stride);
        let bias = self.bias.as_ref().map(Param::val);
        let fold = || self.norm.folded(bias.clone(), |n| n.fold_into_conv(&values(&weight)));
        if mode == Mode::Eval
            && let Some(y) = folded_conv3x3(&x, stride, fold)
        {
            return y;
        }
        let y = conv(x, weight, stride);
        self.norm.forward_relu(y, bias, mode)
    }

    /// The layer on a canvas of pillars, which need not be made, if there is a kernel: in training, with stride 2.
    ///
    /// # Shapes
    /// `features`: `[P, C_in]`; `cells`: P indices into `canvas`, `[B, H, W]`; result `[B, C_out, H / 2, W / 2]`.
    pub fn forward_pillars(&self, features: &Tensor<2>, cells: &[u32], canvas: [usize; 3]) -> Option<Tensor<4>> {
        if self.stride != 2 {
            return None;
        }
        let y = pillar_conv(features, cells, canvas, &self.weight.val())?;
        Some(self.norm.forward_relu(y, self.bias.as_ref().map(Param::val), Mode::Train))
    }
}

impl ConvBnRelu {
    /// Several layers of stride 1 with the same input as one convolution and one norm, whose channels are theirs one
    /// after the other. The same numbers as one layer after the other. `None` without a kernel.
    ///
    /// # Shapes
    /// `x`: `[B, C_in, H, W]`; result `[B, sum of C_out, H, W]`.
    pub fn forward_together(layers: &[&ConvBnRelu], x: &Tensor<4>, mode: Mode) -> Option<Tensor<4>> {
        let epsilon = layers.first()?.norm.epsilon();
        if layers.iter().any(|layer| layer.stride != 1 || layer.norm.epsilon() != epsilon) {
            return None;
        }
        if mode == Mode::Eval {
            return folded_conv3x3(x, 1, || {
                let mut all = Folded { weight: Vec::new(), bias: Vec::new() };
                for layer in layers {
                    let bias = layer.bias.as_ref().map(Param::val);
                    let folded = layer.norm.folded(bias, |n| n.fold_into_conv(&values(&layer.weight.val())));
                    all.weight.extend(folded.weight);
                    all.bias.extend(folded.bias);
                }
                all
            });
        }
        let weight = Tensor::cat(layers.iter().map(|layer| layer.weight.val()).collect(), 0);
        let norms: Vec<&BatchNorm> = layers.iter().map(|layer| &layer.norm).collect();
        let biases: Vec<_> = layers.iter().map(|layer| layer.bias.as_ref().map(Param::val)).collect();
        BatchNorm::forward_relu_together(&norms, &conv3x3(x, &weight, 1)?, &biases)
    }
}

/// 3x3 convolution with padding 1 and without bias, by a kernel if there is one.
///
/// # Shapes
/// `x`: `[B, C_in, H, W]`; `weight`: `[C_out, C_in, 3, 3]`; result `[B, C_out, H / stride, W / stride]`.
fn conv(x: Tensor<4>, weight: Tensor<4>, stride: usize) -> Tensor<4> {
    if products::are_used_on(&x.device()) {
        return multiply(x, weight, |x, weight| products::conv3x3(x, weight, stride));
    }
    conv3x3(&x, &weight, stride).unwrap_or_else(|| {
        let options = ConvOptions::new([stride; 2], [1, 1], [1, 1], 1);
        multiply(x, weight, |x, weight| conv2d(x, weight, None, options))
    })
}

/// The values of a weight on the host.
///
/// # Panics
/// When they are not f32.
pub(super) fn values(weight: &Tensor<4>) -> Vec<f32> {
    host(weight.clone()).expect("weights are f32")
}

/// 3x3 convolution with padding 1 and bias.
#[derive(Module, Debug)]
pub struct Conv {
    /// `[C_out, C_in, 3, 3]`.
    pub weight: Param<Tensor<4>>,
    /// `[C_out]`.
    pub bias: Param<Tensor<1>>,
}

impl Conv {
    /// PyTorch's default weights and biases; `name` keys them.
    pub fn new(name: &str, channels: [usize; 2], init: &Init<'_>) -> Self {
        let [input, output] = channels;
        Conv {
            weight: init.uniform(&format!("{name}.weight"), [output, input, 3, 3], input * 9),
            bias: init.uniform(&format!("{name}.bias"), [output], input * 9),
        }
    }

    /// # Shapes
    /// `x`: `[B, C_in, H, W]`; result `[B, C_out, H, W]`.
    pub fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let bias = self.bias.val();
        let channels = bias.dims()[0];
        conv(x, self.weight.val(), 1) + bias.reshape([1, channels, 1, 1])
    }

    /// Several convolutions as one, each of which reads its own part of the channels: the inputs are one after the
    /// other in `x`, and so are the outputs in the result. A weight between a convolution and another one's input is
    /// zero.
    ///
    /// # Shapes
    /// `x`: `[B, sum of C_in, H, W]`; result `[B, sum of C_out, H, W]`.
    pub fn forward_together(convs: &[&Conv], x: Tensor<4>) -> Tensor<4> {
        let inputs: Vec<usize> = convs.iter().map(|conv| conv.weight.dims()[1]).collect();
        let device = x.device();
        let rows = convs.iter().enumerate().map(|(k, conv)| {
            let outputs = conv.weight.dims()[0];
            let zeros = |from: &[usize]| {
                let inputs: usize = from.iter().sum();
                (inputs > 0).then(|| Tensor::zeros([outputs, inputs, 3, 3], &device))
            };
            let parts = [zeros(&inputs[..k]), Some(conv.weight.val()), zeros(&inputs[k + 1..])];
            Tensor::cat(parts.into_iter().flatten().collect(), 1) // [C_out, sum of C_in, 3, 3]
        });
        let weight = Tensor::cat(rows.collect(), 0);
        let bias = Tensor::cat(convs.iter().map(|conv| conv.bias.val()).collect(), 0);
        let channels = bias.dims()[0];
        conv(x, weight, 1) + bias.reshape([1, channels, 1, 1])
    }
}

/// 1x1 convolution with bias.
#[derive(Module, Debug)]
pub struct PointwiseConv {
    /// `[C_out, C_in, 1, 1]`.
    pub weight: Param<Tensor<4>>,
    /// `[C_out]`.
    pub bias: Param<Tensor<1>>,
}

impl PointwiseConv {
    /// PyTorch's default weights; biases as given, or PyTorch's default.
    pub fn new(name: &str, channels: [usize; 2], init: &Init<'_>) -> Self {
        let [input, output] = channels;
        PointwiseConv {
            weight: init.uniform(&format!("{name}.weight"), [output, input, 1, 1], input),
            bias: init.uniform(&format!("{name}.bias"), [output], input),
        }
    }

    /// Applies several of them to one image; the outputs of a pixel form a row.
    ///
    /// # Shapes
    /// `x`: `[B, C_in, H, W]`; results `[B * H * W, C_out]`.
    pub fn forward_rows<const N: usize>(convs: [&PointwiseConv; N], x: Tensor<4>) -> [Tensor<2>; N] {
        let parameters = convs.map(|conv| (conv.weight.val(), conv.bias.val()));
        pixel_heads(&x, parameters.each_ref().map(|(weight, bias)| (weight, bias))).unwrap_or_else(|| {
            let by_products = products::are_used_on(&x.device());
            parameters.map(|(weight, bias)| {
                if by_products {
                    let ([b, c, h, w], k) = (x.dims(), bias.dims()[0]);
                    let (x, weight) = (x.clone().reshape([b, c, h * w]), weight.reshape([k, c]));
                    let y = multiply(x, weight, products::combine_channels); // [B, C_out, H * W]
                    return products::add_to_rows(y.swap_dims(1, 2).reshape([b * h * w, k]), bias);
                }
                let y = conv2d(x.clone(), weight, Some(bias), ConvOptions::new([1, 1], [0, 0], [1, 1], 1));
                let [b, k, h, w] = y.dims();
                y.permute([0, 2, 3, 1]).reshape([b * h * w, k]) // [B, H, W, C_out] -> [B * H * W, C_out]
            })
        })
    }
}
