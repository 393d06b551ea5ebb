//! Convolutions with batch norm and ReLU.

use super::precision::multiply;
use super::{BatchNorm, Init, Mode, host};
use crate::kernel_ops::{conv3x3, folded_conv3x3, folded_transposed, pixel_heads, transposed};
use burn::module::{Module, Param};
use burn::tensor::Tensor;
use burn::tensor::activation::relu;
use burn::tensor::module::{conv_transpose2d, conv2d};
use burn::tensor::ops::{ConvOptions, ConvTransposeOptions};

/// 3x3 convolution with padding 1 and no bias, batch normalisation, ReLU.
#[derive(Module, Debug)]
pub struct ConvBnRelu {
    /// `[C_out, C_in, 3, 3]`.
    pub weight: Param<Tensor<4>>,
    /// The batch norm after the convolution.
    pub norm: BatchNorm,
    stride: usize,
}

impl ConvBnRelu {
    /// A layer of the given channels and stride; `name` keys its initial weights.
    pub fn new(name: &str, channels: [usize; 2], stride: usize, norm: BatchNorm, init: &Init<'_>) -> Self {
        let [input, output] = channels;
        ConvBnRelu { weight: init.uniform(name, [output, input, 3, 3], input * 9), norm, stride }
    }

    /// # Shapes
    /// `x`: `[B, C_in, H, W]`; result `[B, C_out, H / stride, W / stride]`.
    pub fn forward(&self, x: Tensor<4>, mode: Mode) -> Tensor<4> {
        let (weight, stride) = (self.weight.val(), self.stride);
        if mode == Mode::Eval
            && let Some(y) = folded_conv3x3(&x, stride, || self.norm.folded(|n| n.fold_into_conv(&values(&weight))))
        {
            return y;
        }
        let y = conv3x3(&x, &weight, stride).unwrap_or_else(|| {
            let options = ConvOptions::new([stride; 2], [1, 1], [1, 1], 1);
            multiply(x, weight, |x, weight| conv2d(x, weight, None, options))
        });
        norm_relu(&self.norm, y, mode)
    }
}

/// Transposed convolution with kernel = stride and no bias, batch normalisation, ReLU.
#[derive(Module, Debug)]
pub struct DeconvBnRelu {
    /// `[C_in, C_out, stride, stride]`.
    pub weight: Param<Tensor<4>>,
    /// The batch norm after the convolution.
    pub norm: BatchNorm,
    stride: usize,
}

impl DeconvBnRelu {
    /// A layer of the given channels and stride; `name` keys its initial weights.
    pub fn new(name: &str, channels: [usize; 2], stride: usize, norm: BatchNorm, init: &Init<'_>) -> Self {
        let [input, output] = channels;
        let fan = output * stride * stride;
        DeconvBnRelu { weight: init.uniform(name, [input, output, stride, stride], fan), norm, stride }
    }

    /// # Shapes
    /// `x`: `[B, C_in, H, W]`; result `[B, C_out, H * stride, W * stride]`.
    pub fn forward(&self, x: Tensor<4>, mode: Mode) -> Tensor<4> {
        let (weight, stride) = (self.weight.val(), self.stride);
        let fold = || self.norm.folded(|n| n.fold_into_transposed(&values(&weight), stride));
        if mode == Mode::Eval
            && let Some(y) = folded_transposed(&x, stride, fold)
        {
            return y;
        }
        let y = transposed(&x, &weight, stride).unwrap_or_else(|| {
            let options = ConvTransposeOptions::new([stride; 2], [0, 0], [0, 0], [1, 1], 1);
            multiply(x, weight, |x, weight| conv_transpose2d(x, weight, None, options))
        });
        norm_relu(&self.norm, y, mode)
    }
}

fn norm_relu(norm: &BatchNorm, x: Tensor<4>, mode: Mode) -> Tensor<4> {
    match mode {
        Mode::Train => norm.forward_train_relu(x),
        Mode::Eval => relu(norm.forward_eval(x)),
    }
}

fn values(weight: &Tensor<4>) -> Vec<f32> {
    host(weight.clone()).expect("weights are f32")
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
            parameters.map(|(weight, bias)| {
                let y = conv2d(x.clone(), weight, Some(bias), ConvOptions::new([1, 1], [0, 0], [1, 1], 1));
                let [b, k, h, w] = y.dims();
                y.permute([0, 2, 3, 1]).reshape([b * h * w, k]) // [B, H, W, C_out] -> [B * H * W, C_out]
            })
        })
    }
}
