//! 3x3 convolutions: by a kernel of the device, or as products with an unfolded image.

use super::backend::{Products, part, parts_of_sum, reshape, sum_of_pixels, sum_of_products, tiles};
use super::unfold::{Gather, strided};
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::tensor::{FloatTensor, IntTensor};
use burn::backend::{Autodiff, Backend, Dispatch, Flex, NdArray, TensorMetadata};
use burn::tensor::Shape;

/// Most values of the unfolded images that are made at once: 512 MiB in single precision.
const MOST_UNFOLDED: usize = 1 << 27;

/// 3x3 convolutions of images that are not unfolded, on devices that have a kernel for them.
pub trait Convolutions: Backend {
    /// Whether there is one for an image.
    fn has_convolutions(_x: &FloatTensor<Self>) -> bool {
        false
    }

    /// # Shapes
    /// `weight`: `[9, M, C]`; `x`: `[B, C, pixels]`; `taps`: `[9 * N]`, see [`Gather::Unfold`]; result `[B, M, N]`.
    fn convolution(
        _weight: &FloatTensor<Self>,
        _x: &FloatTensor<Self>,
        _taps: &IntTensor<Self>,
    ) -> Option<FloatTensor<Self>> {
        None
    }

    /// The gradient by the weight, of each frame and part of the pixels.
    ///
    /// # Shapes
    /// `dy`: `[B, M, N]`; `x`: `[B, C, pixels]`; `taps`: `[9 * N]`; result `[B * parts, 9, M, C]`.
    fn convolution_gradient(
        _dy: &FloatTensor<Self>,
        _x: &FloatTensor<Self>,
        _taps: &IntTensor<Self>,
        _parts: usize,
    ) -> Option<FloatTensor<Self>> {
        None
    }
}

impl Convolutions for Flex {}

impl Convolutions for NdArray {}

impl Convolutions for Dispatch {}

impl<B: Backend, C: CheckpointStrategy> Convolutions for Autodiff<B, C> {}

#[cfg(feature = "cube")]
impl Convolutions for burn::backend::Cube {
    fn has_convolutions(x: &FloatTensor<Self>) -> bool {
        crate::gpu_kernels::has_convolutions(x)
    }

    fn convolution(
        weight: &FloatTensor<Self>,
        x: &FloatTensor<Self>,
        taps: &IntTensor<Self>,
    ) -> Option<FloatTensor<Self>> {
        crate::gpu_kernels::convolution(weight, x, taps)
    }

    fn convolution_gradient(
        dy: &FloatTensor<Self>,
        x: &FloatTensor<Self>,
        taps: &IntTensor<Self>,
        parts: usize,
    ) -> Option<FloatTensor<Self>> {
        crate::gpu_kernels::convolution_gradient(dy, x, taps, parts)
    }
}

/// `work` on as many frames at a time as [`MOST_UNFOLDED`] allows, if each takes `values`.
fn frame_by_frame<B: Backend>(
    frames: usize,
    values: usize,
    work: impl Fn(usize, usize) -> FloatTensor<B>,
) -> Vec<FloatTensor<B>> {
    let at_once = (MOST_UNFOLDED / values.max(1)).clamp(1, frames.max(1));
    (0..frames).step_by(at_once).map(|from| work(from, (from + at_once).min(frames))).collect()
}

fn cat<B: Backend>(mut parts: Vec<FloatTensor<B>>) -> FloatTensor<B> {
    if parts.len() == 1 { parts.remove(0) } else { B::float_cat(parts, 0) }
}

/// Values of each channel at an index into its pixels, or 0 behind the last pixel.
///
/// # Shapes
/// `x`: `[B, C, N]`; result `[B, C, size of the index]`.
fn gather_pixels<B: Backend>(x: FloatTensor<B>, gather: Gather, size: [usize; 2], stride: usize) -> FloatTensor<B> {
    let [batch, channels, pixels] = x.shape().dims();
    let device = x.device();
    let nothing = B::float_zeros(Shape::from([batch * channels, 1]), &device, x.dtype().into());
    let x = B::float_cat(vec![reshape::<B>(x, [batch * channels, pixels]), nothing], 1);
    let index = gather.on_device::<B>(size, stride, &device);
    let count = index.shape()[0];
    reshape::<B>(B::float_select(x, 1, index), [batch, channels, count])
}

/// What the taps of a kernel read at each pixel of the result.
///
/// # Shapes
/// `x`: `[B, C, H, W]`; result `[B, C * 9, N]`.
fn unfold<B: Backend>(x: FloatTensor<B>, stride: usize) -> FloatTensor<B> {
    let [batch, channels, height, width] = x.shape().dims();
    let x = reshape::<B>(x, [batch, channels, height * width]);
    let taps = gather_pixels::<B>(x, Gather::Unfold, [height, width], stride);
    let pixels = taps.shape()[2] / 9;
    reshape::<B>(taps, [batch, channels * 9, pixels])
}

/// Without the kernels of [`Convolutions`] the image is unfolded.
pub(super) fn convolve<B: Products>(x: FloatTensor<B>, weight: FloatTensor<B>, stride: usize) -> FloatTensor<B> {
    let ([batch, inputs, height, width], [outputs, ..]) = (x.shape().dims::<4>(), weight.shape().dims::<4>());
    let (rows, columns) = (strided(height, stride), strided(width, stride));
    if B::has_convolutions(&x) {
        let by_tap = B::float_permute(reshape::<B>(weight.clone(), [outputs, inputs, 9]), &[2, 0, 1]);
        let by_tap = reshape::<B>(reshape::<B>(by_tap, [9 * outputs * inputs]), [9, outputs, inputs]);
        let (image, taps) = image_and_taps::<B>(&x, stride);
        if let Some(y) = B::convolution(&by_tap, &image, &taps) {
            return reshape::<B>(y, [batch, outputs, rows, columns]);
        }
    }
    let weight = reshape::<B>(weight, [1, outputs, inputs * 9]);
    let parts = frame_by_frame::<B>(batch, inputs * 9 * rows * columns, |from, to| {
        B::product(weight.clone(), unfold::<B>(part::<B>(&x, from, to), stride)) // [b, C_out, N]
    });
    reshape::<B>(cat::<B>(parts), [batch, outputs, rows, columns])
}

/// An image `[B, C, pixels]`, and the pixels that the taps of a 3x3 kernel read.
fn image_and_taps<B: Backend>(x: &FloatTensor<B>, stride: usize) -> (FloatTensor<B>, IntTensor<B>) {
    let [batch, channels, height, width] = x.shape().dims::<4>();
    let taps = Gather::Unfold.on_device::<B>([height, width], stride, &x.device());
    (reshape::<B>(x.clone(), [batch, channels, height * width]), taps)
}

/// The gradient of a convolution by its image.
pub(super) fn convolve_back<B: Products>(
    dy: FloatTensor<B>,
    weight: FloatTensor<B>,
    [height, width]: [usize; 2],
    stride: usize,
) -> FloatTensor<B> {
    let ([batch, outputs, rows, columns], [_, inputs, ..]) = (dy.shape().dims::<4>(), weight.shape().dims::<4>());
    if stride == 1 {
        // A convolution with the kernel turned by half a turn.
        let weight = B::float_flip(reshape::<B>(weight, [outputs, inputs, 9]), &[2]);
        let weight = reshape::<B>(B::float_permute(weight, &[1, 0, 2]), [inputs, outputs, 3, 3]);
        return convolve::<B>(dy, weight, 1);
    }
    let folds = Gather::folds(stride);
    let weight = B::float_transpose(reshape::<B>(weight, [outputs, inputs * 9]));
    let weight = reshape::<B>(weight, [1, inputs * 9, outputs]);
    let parts = frame_by_frame::<B>(batch, inputs * (9 * rows * columns).max(folds * height * width), |from, to| {
        let frames = to - from;
        let dy = reshape::<B>(part::<B>(&dy, from, to), [frames, outputs, rows * columns]);
        let taps = reshape::<B>(B::product(weight.clone(), dy), [frames, inputs, 9 * rows * columns]);
        let terms = gather_pixels::<B>(taps, Gather::Fold, [height, width], stride);
        let terms = reshape::<B>(terms, [frames * inputs, folds, height * width]);
        reshape::<B>(B::float_sum_dim(terms, 1), [frames, inputs, height, width])
    });
    cat::<B>(parts)
}

pub(super) fn convolution_weight_gradient<B: Products>(
    x: FloatTensor<B>,
    dy: FloatTensor<B>,
    stride: usize,
) -> FloatTensor<B> {
    let ([batch, inputs, ..], [_, outputs, rows, columns]) = (x.shape().dims::<4>(), dy.shape().dims::<4>());
    let pixels = rows * columns;
    let dy = reshape::<B>(dy, [batch, outputs, pixels]);
    if B::has_convolutions(&x) {
        let (image, taps) = image_and_taps::<B>(&x, stride);
        let parts = parts_of_sum(batch, 9 * tiles([outputs, inputs]), pixels);
        if let Some(products) = B::convolution_gradient(&dy, &image, &taps, parts) {
            let sum = sum_of_products::<B>(products, [batch * parts, 9 * outputs, inputs]);
            let sum = B::float_permute(reshape::<B>(sum, [9, outputs, inputs]), &[1, 2, 0]);
            return reshape::<B>(sum, [outputs, inputs, 3, 3]);
        }
    }
    let parts = frame_by_frame::<B>(batch, inputs * 9 * pixels, |from, to| {
        sum_of_pixels::<B>(part::<B>(&dy, from, to), unfold::<B>(part::<B>(&x, from, to), stride))
    });
    let sum = parts.into_iter().reduce(|a, b| B::float_add(a, b)).expect("a batch has frames");
    reshape::<B>(sum, [outputs, inputs, 3, 3])
}
