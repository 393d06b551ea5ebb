//! Convolutions and linear layers as matrix products, for GPUs.
//!
//! burn's own convolutions take the direct strategy on a device without tensor cores of single precision, and their
//! gradients by the weights a convolution with a kernel as large as the image. On tensor cores of bf16 a kernel looks
//! up what the taps read; elsewhere an image is unfolded (`im2col`, Chellapilla et al. 2006): a gather whose index is
//! known on the host. The gradients are a gather and a product as well. A product over all pixels is split into many,
//! so that every multiprocessor has work, and their results are added in a fixed order: the same bits in every run on
//! the same device.

#[expect(deprecated, reason = "NdArray is kept as long as burn has it")]
mod backend;
#[expect(deprecated, reason = "NdArray is kept as long as burn has it")]
mod convolution;
mod unfold;

use backend::Products as _;
#[cfg(feature = "cube")]
pub(crate) use backend::TILE;
use burn::backend::Dispatch;
use burn::tensor::{Device, Tensor};

/// Whether these operations are used on a device: on GPUs.
pub fn are_used_on(device: &Device) -> bool {
    #[cfg(feature = "cube")]
    return matches!(device.clone().inner().as_dispatch(), burn::backend::DispatchDevice::Cube(_));
    #[cfg(not(feature = "cube"))]
    {
        let _ = device;
        false
    }
}

/// 3x3 convolution with padding 1 and without bias.
///
/// # Shapes
/// `x`: `[B, C_in, H, W]`; `weight`: `[C_out, C_in, 3, 3]`; result `[B, C_out, ceil(H / stride), ceil(W / stride)]`.
pub fn conv3x3(x: Tensor<4>, weight: Tensor<4>, stride: usize) -> Tensor<4> {
    Tensor::from_dispatch(Dispatch::conv3x3(x.into_dispatch(), weight.into_dispatch(), stride))
}

/// 1x1 convolution: a linear combination of the channels of each pixel.
///
/// # Shapes
/// `x`: `[B, C_in, N]`; `weight`: `[C_out, C_in]`; result `[B, C_out, N]`.
pub fn combine_channels(x: Tensor<3>, weight: Tensor<2>) -> Tensor<3> {
    Tensor::from_dispatch(Dispatch::combine_channels(x.into_dispatch(), weight.into_dispatch()))
}

/// Transposed convolution with kernel = stride, without bias.
///
/// # Shapes
/// `x`: `[B, C_in, H, W]`; `weight`: `[C_in, C_out, s, s]`; result `[B, C_out, H * s, W * s]`.
pub fn transposed(x: Tensor<4>, weight: Tensor<4>) -> Tensor<4> {
    let ([batch, inputs, height, width], [_, outputs, s, _]) = (x.dims(), weight.dims());
    let matrix = weight.reshape([inputs, outputs * s * s]).transpose(); // [C_out * s * s, C_in]
    let y = combine_channels(x.reshape([batch, inputs, height * width]), matrix);
    let y = y.reshape([batch, outputs, s, s, height, width]).permute([0, 1, 4, 2, 5, 3]); // [B, C, H, s, W, s]
    y.reshape([batch, outputs, height * s, width * s])
}

/// Convolution with kernel = stride, without padding and bias.
///
/// # Shapes
/// `x`: `[B, C_in, H, W]`; `weight`: `[C_out, C_in, s, s]`; result `[B, C_out, floor(H / s), floor(W / s)]`.
pub fn strided(x: Tensor<4>, weight: Tensor<4>) -> Tensor<4> {
    let ([batch, inputs, height, width], [outputs, _, s, _]) = (x.dims(), weight.dims());
    let (rows, columns) = (height / s, width / s);
    let x = x.narrow(2, 0, rows * s).narrow(3, 0, columns * s).reshape([batch, inputs, rows, s, columns, s]);
    let x = x.permute([0, 1, 3, 5, 2, 4]).reshape([batch, inputs * s * s, rows * columns]); // [B, C, s, s, H, W]
    let y = combine_channels(x, weight.reshape([outputs, inputs * s * s]));
    y.reshape([batch, outputs, rows, columns])
}

/// Linear layer over rows, without bias.
///
/// # Shapes
/// `x`: `[N, C_in]`; `weight`: `[C_out, C_in]`; result `[N, C_out]`.
pub fn rows_by(x: Tensor<2>, weight: Tensor<2>) -> Tensor<2> {
    Tensor::from_dispatch(Dispatch::rows_by(x.into_dispatch(), weight.into_dispatch()))
}

/// A bias added to rows.
///
/// # Shapes
/// `y` and result: `[N, C]`; `bias`: `[C]`.
pub fn add_to_rows(y: Tensor<2>, bias: Tensor<1>) -> Tensor<2> {
    Tensor::from_dispatch(Dispatch::add_to_rows(y.into_dispatch(), bias.into_dispatch()))
}

#[cfg(test)]
mod tests;
