//! The operations on the primitives of every backend, and their gradients.

use super::unfold::{Gather, strided};
use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind, binary};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Flex, NdArray, TensorMetadata, backend_extension};
use burn::tensor::{FloatDType, Shape, Slice};

/// Most values of the unfolded images that are made at once: 512 MiB in single precision.
const MOST_UNFOLDED: usize = 1 << 27;

/// Tiles of a gradient by a weight that are made side by side, at least, if there are pixels or rows enough.
const SIDE_BY_SIDE: usize = 1024;

/// Rows and columns of a tile of a product.
pub(crate) const TILE: usize = 64;

/// Terms of each product of a sum, at least.
const LEAST_TERMS: usize = 128;

/// The number of products that a sum over products `[rows, columns]` is split into.
fn side_by_side([rows, columns]: [usize; 2]) -> usize {
    SIDE_BY_SIDE.div_ceil(rows.div_ceil(TILE) * columns.div_ceil(TILE))
}

/// Products. Without autodiff they are compositions of the backend's operations.
#[backend_extension(Flex, NdArray, Cube: cfg(feature = "cube"), Autodiff)]
pub trait Products: Backend {
    /// The product of two matrices, or of many side by side.
    fn product(a: FloatTensor<Self>, b: FloatTensor<Self>) -> FloatTensor<Self> {
        Self::float_matmul(a, b)
    }

    /// The sum over the first dimension.
    ///
    /// # Shapes
    /// `x`: `[P, N]`; result `[1, N]`.
    fn sum_of_first(x: FloatTensor<Self>) -> FloatTensor<Self> {
        Self::float_sum_dim(x, 0)
    }

    /// The sum over all rows.
    ///
    /// # Shapes
    /// `x`: `[N, C]`; result `[1, C]`.
    fn sum_of_rows(x: FloatTensor<Self>) -> FloatTensor<Self> {
        Self::float_sum_dim(x, 0)
    }

    /// See [`super::add_to_rows`].
    fn add_to_rows(y: FloatTensor<Self>, bias: FloatTensor<Self>) -> FloatTensor<Self> {
        let channels = bias.shape()[0];
        Self::float_add(y, reshape::<Self>(bias, [1, channels]))
    }

    /// See [`super::conv3x3`].
    fn conv3x3(x: FloatTensor<Self>, weight: FloatTensor<Self>, stride: usize) -> FloatTensor<Self> {
        convolve::<Self>(x, weight, stride)
    }

    /// See [`super::combine_channels`].
    fn combine_channels(x: FloatTensor<Self>, weight: FloatTensor<Self>) -> FloatTensor<Self> {
        let [outputs, inputs] = weight.shape().dims();
        Self::product(reshape::<Self>(weight, [1, outputs, inputs]), x)
    }

    /// See [`super::rows_by`].
    fn rows_by(x: FloatTensor<Self>, weight: FloatTensor<Self>) -> FloatTensor<Self> {
        Self::product(x, Self::float_transpose(weight))
    }
}

impl Products for Flex {}

impl Products for NdArray {}

#[cfg(feature = "cube")]
impl Products for burn::backend::Cube {
    fn product(a: FloatTensor<Self>, b: FloatTensor<Self>) -> FloatTensor<Self> {
        use burn::backend::ops::FloatTensorOps as _;
        crate::gpu_kernels::product(&a, &b).unwrap_or_else(|| Self::float_matmul(a, b))
    }

    fn sum_of_rows(x: FloatTensor<Self>) -> FloatTensor<Self> {
        use burn::backend::ops::FloatTensorOps as _;
        crate::gpu_kernels::sum_of_rows(&x).unwrap_or_else(|| Self::float_sum_dim(x, 0))
    }

    fn sum_of_first(x: FloatTensor<Self>) -> FloatTensor<Self> {
        use burn::backend::ops::FloatTensorOps as _;
        crate::gpu_kernels::sum_of_first(&x).unwrap_or_else(|| Self::float_sum_dim(x, 0))
    }
}

/// An operation of two tensors whose gradients need both.
macro_rules! tracked {
    ($operation:expr, $x:ident, $weight:ident, |$a:ident, $b:ident| $forward:expr) => {{
        let (($a, x_node), ($b, weight_node)) = ($x.into_parts(), $weight.into_parts());
        let kept = ($a.clone(), $b.clone());
        let y = $forward;
        match $operation.prepare::<C>([x_node, weight_node]).compute_bound().stateful() {
            OpsKind::Tracked(prepared) => prepared.finish(kept, y),
            OpsKind::UnTracked(prepared) => prepared.finish(y),
        }
    }};
}

impl<B: Products, C: CheckpointStrategy> Products for Autodiff<B, C> {
    fn conv3x3(x: FloatTensor<Self>, weight: FloatTensor<Self>, stride: usize) -> FloatTensor<Self> {
        tracked!(Conv3x3 { stride }, x, weight, |a, b| B::conv3x3(a, b, stride))
    }

    fn combine_channels(x: FloatTensor<Self>, weight: FloatTensor<Self>) -> FloatTensor<Self> {
        tracked!(CombineChannels, x, weight, |a, b| B::combine_channels(a, b))
    }

    fn add_to_rows(y: FloatTensor<Self>, bias: FloatTensor<Self>) -> FloatTensor<Self> {
        let ((y, y_node), (bias, bias_node)) = (y.into_parts(), bias.into_parts());
        let channels = bias.shape()[0];
        let sum = B::add_to_rows(y, bias);
        AddToRows { channels }.prepare::<C>([y_node, bias_node]).compute_bound().stateless(sum)
    }

    fn rows_by(x: FloatTensor<Self>, weight: FloatTensor<Self>) -> FloatTensor<Self> {
        tracked!(RowsBy, x, weight, |a, b| B::rows_by(a, b))
    }
}

#[derive(Debug)]
struct Conv3x3 {
    stride: usize,
}

impl<B: Products> Backward<B, 2> for Conv3x3 {
    /// Image and weight.
    type State = (FloatTensor<B>, FloatTensor<B>);

    fn backward(self, ops: Ops<Self::State, 2>, grads: &mut Gradients, _: &mut Checkpointer) {
        let ((x, weight), stride) = (ops.state, self.stride);
        let [_, _, height, width] = x.shape().dims();
        let by_x = |dy| convolve_back::<B>(dy, weight, [height, width], stride);
        binary::<B, _, _>(ops.parents, ops.node, grads, by_x, |dy| convolution_weight_gradient::<B>(x, dy, stride));
    }
}

#[derive(Debug)]
struct CombineChannels;

impl<B: Products> Backward<B, 2> for CombineChannels {
    /// Image and weight.
    type State = (FloatTensor<B>, FloatTensor<B>);

    fn backward(self, ops: Ops<Self::State, 2>, grads: &mut Gradients, _: &mut Checkpointer) {
        let (x, weight) = ops.state;
        let by_x = |dy| B::combine_channels(dy, B::float_transpose(weight));
        binary::<B, _, _>(ops.parents, ops.node, grads, by_x, |dy| sum_of_pixels::<B>(dy, x));
    }
}

#[derive(Debug)]
struct RowsBy;

impl<B: Products> Backward<B, 2> for RowsBy {
    /// Rows and weight.
    type State = (FloatTensor<B>, FloatTensor<B>);

    fn backward(self, ops: Ops<Self::State, 2>, grads: &mut Gradients, _: &mut Checkpointer) {
        let (x, weight) = ops.state;
        let by_x = |dy| B::product(dy, weight);
        binary::<B, _, _>(ops.parents, ops.node, grads, by_x, |dy| products_of_rows::<B>(dy, x));
    }
}

#[derive(Debug)]
struct AddToRows {
    channels: usize,
}

impl<B: Products> Backward<B, 2> for AddToRows {
    type State = ();

    fn backward(self, ops: Ops<Self::State, 2>, grads: &mut Gradients, _: &mut Checkpointer) {
        let by_bias = |dy| reshape::<B>(B::sum_of_rows(dy), [self.channels]);
        binary::<B, _, _>(ops.parents, ops.node, grads, |dy| dy, by_bias);
    }
}

fn reshape<B: Backend>(x: FloatTensor<B>, shape: impl Into<Shape>) -> FloatTensor<B> {
    B::float_reshape(x, shape.into())
}

/// Some of the first dimension; a copy, unless it is all of it.
fn part<B: Backend>(x: &FloatTensor<B>, from: usize, to: usize) -> FloatTensor<B> {
    if to - from == x.shape()[0] {
        return x.clone();
    }
    B::float_slice(x.clone(), &[Slice::from(from..to)])
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

fn convolve<B: Products>(x: FloatTensor<B>, weight: FloatTensor<B>, stride: usize) -> FloatTensor<B> {
    let ([batch, inputs, height, width], [outputs, ..]) = (x.shape().dims::<4>(), weight.shape().dims::<4>());
    let (rows, columns) = (strided(height, stride), strided(width, stride));
    let weight = reshape::<B>(weight, [1, outputs, inputs * 9]);
    let parts = frame_by_frame::<B>(batch, inputs * 9 * rows * columns, |from, to| {
        B::product(weight.clone(), unfold::<B>(part::<B>(&x, from, to), stride)) // [b, C_out, N]
    });
    reshape::<B>(cat::<B>(parts), [batch, outputs, rows, columns])
}

/// The gradient of a convolution by its image.
fn convolve_back<B: Products>(
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

fn convolution_weight_gradient<B: Products>(x: FloatTensor<B>, dy: FloatTensor<B>, stride: usize) -> FloatTensor<B> {
    let ([batch, inputs, ..], [_, outputs, rows, columns]) = (x.shape().dims::<4>(), dy.shape().dims::<4>());
    let pixels = rows * columns;
    let dy = reshape::<B>(dy, [batch, outputs, pixels]);
    let parts = frame_by_frame::<B>(batch, inputs * 9 * pixels, |from, to| {
        sum_of_pixels::<B>(part::<B>(&dy, from, to), unfold::<B>(part::<B>(&x, from, to), stride))
    });
    let sum = parts.into_iter().reduce(|a, b| B::float_add(a, b)).expect("a batch has frames");
    reshape::<B>(sum, [outputs, inputs, 3, 3])
}

/// The sum over frames and pixels of products of two vectors of channels.
///
/// # Shapes
/// `a`: `[B, C_a, N]`; `b`: `[B, C_b, N]`; result `[C_a, C_b]`.
fn sum_of_pixels<B: Products>(a: FloatTensor<B>, b: FloatTensor<B>) -> FloatTensor<B> {
    let ([batch, rows, pixels], columns) = (a.shape().dims(), b.shape()[1]);
    let wanted = side_by_side([rows, columns]).div_ceil(batch.max(1)).min(pixels / LEAST_TERMS).max(1);
    let parts = (wanted..=2 * wanted).find(|parts| pixels % parts == 0).unwrap_or(1);
    let split = |x: FloatTensor<B>, last: bool| {
        let channels = x.shape()[1];
        let x = reshape::<B>(x, [batch, channels, parts, pixels / parts]);
        B::float_permute(x, if last { &[0, 2, 3, 1] } else { &[0, 2, 1, 3] })
    };
    let products = B::product(split(a, false), split(b, true)); // [B, parts, C_a, C_b]
    sum_of_products::<B>(products, [batch * parts, rows, columns])
}

/// The sum over rows of their products.
///
/// # Shapes
/// `a`: `[N, C_a]`; `b`: `[N, C_b]`; result `[C_a, C_b]`.
fn products_of_rows<B: Products>(a: FloatTensor<B>, b: FloatTensor<B>) -> FloatTensor<B> {
    let ([rows, of_a], of_b) = (a.shape().dims(), b.shape()[1]);
    let terms = (rows / side_by_side([of_a, of_b])).max(LEAST_TERMS);
    let (parts, rest) = (rows / terms, rows % terms);
    let product = |from: usize, parts: usize, terms: usize| {
        let of = |x: &FloatTensor<B>, channels: usize| {
            reshape::<B>(part::<B>(x, from, from + parts * terms), [parts, terms, channels])
        };
        let products = B::product(B::float_swap_dims(of(&a, of_a), 1, 2), of(&b, of_b));
        sum_of_products::<B>(products, [parts, of_a, of_b])
    };
    match (parts, rest) {
        (0, 0) => B::float_zeros(Shape::from([of_a, of_b]), &a.device(), a.dtype().into()),
        (0, rest) => product(0, 1, rest),
        (parts, 0) => product(0, parts, terms),
        (parts, rest) => B::float_add(product(0, parts, terms), product(parts * terms, 1, rest)),
    }
}

/// The sum of some products, in single precision.
fn sum_of_products<B: Products>(products: FloatTensor<B>, [count, rows, columns]: [usize; 3]) -> FloatTensor<B> {
    let precision: FloatDType = products.dtype().into();
    let products = reshape::<B>(products, [count, rows * columns]);
    if count == 1 {
        return reshape::<B>(products, [rows, columns]);
    }
    let sum = B::sum_of_first(B::float_cast(products, FloatDType::F32));
    B::float_cast(reshape::<B>(sum, [rows, columns]), precision)
}
