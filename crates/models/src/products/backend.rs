//! The operations on the primitives of every backend, and their gradients.

use super::convolution::{Convolutions, convolution_weight_gradient, convolve, convolve_back};
use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind, binary};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Flex, NdArray, TensorMetadata, backend_extension};
use burn::tensor::{FloatDType, Shape, Slice};

/// Tiles of a gradient by a weight that are made side by side, at least, if there are pixels or rows enough.
const SIDE_BY_SIDE: usize = 1024;

/// Rows and columns of a tile of a product.
pub(crate) const TILE: usize = 64;

/// Terms of each product of a sum, at least.
const LEAST_TERMS: usize = 128;

/// Tiles of a product `[rows, columns]`.
pub(super) fn tiles([rows, columns]: [usize; 2]) -> usize {
    rows.div_ceil(TILE) * columns.div_ceil(TILE)
}

/// Products. Without autodiff they are compositions of the backend's operations.
#[backend_extension(Flex, NdArray, Cube: cfg(feature = "cube"), Autodiff)]
pub trait Products: Convolutions {
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

pub(super) fn reshape<B: Backend>(x: FloatTensor<B>, shape: impl Into<Shape>) -> FloatTensor<B> {
    B::float_reshape(x, shape.into())
}

/// Some of the first dimension; a copy, unless it is all of it.
pub(super) fn part<B: Backend>(x: &FloatTensor<B>, from: usize, to: usize) -> FloatTensor<B> {
    if to - from == x.shape()[0] {
        return x.clone();
    }
    B::float_slice(x.clone(), &[Slice::from(from..to)])
}

/// The parts of the pixels of a frame whose products are made side by side, with a number of tiles each.
pub(super) fn parts_of_sum(batch: usize, of_part: usize, pixels: usize) -> usize {
    let wanted = SIDE_BY_SIDE.div_ceil(of_part * batch.max(1)).min(pixels / LEAST_TERMS).max(1);
    (wanted..=2 * wanted).find(|parts| pixels.is_multiple_of(*parts)).unwrap_or(1)
}

/// The sum over frames and pixels of products of two vectors of channels.
///
/// # Shapes
/// `a`: `[B, C_a, N]`; `b`: `[B, C_b, N]`; result `[C_a, C_b]`.
pub(super) fn sum_of_pixels<B: Products>(a: FloatTensor<B>, b: FloatTensor<B>) -> FloatTensor<B> {
    let ([batch, rows, pixels], columns) = (a.shape().dims(), b.shape()[1]);
    let parts = parts_of_sum(batch, tiles([rows, columns]), pixels);
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
    let terms = (rows / SIDE_BY_SIDE.div_ceil(tiles([of_a, of_b]))).max(LEAST_TERMS);
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
pub(super) fn sum_of_products<B: Products>(
    products: FloatTensor<B>,
    [count, rows, columns]: [usize; 3],
) -> FloatTensor<B> {
    let precision: FloatDType = products.dtype().into();
    let products = reshape::<B>(products, [count, rows * columns]);
    if count == 1 {
        return reshape::<B>(products, [rows, columns]);
    }
    let sum = B::sum_of_first(B::float_cast(products, FloatDType::F32));
    B::float_cast(reshape::<B>(sum, [rows, columns]), precision)
}
