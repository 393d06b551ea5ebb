//! Batch normalisation with the statistics of the batch, optionally with a ReLU.

use super::units::{end_of, passed, place, rectified, sum_of_cube, sum_of_parts};
use super::{Primitive, UNITS, argument, cubes, is_plain, unset_like};
use crate::layers;
use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::NoCheckpointing;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, NodeGuard, Ops, OpsKind};
use burn::backend::ops::FloatTensorOps;
use burn::backend::{Autodiff, Cube, TensorMetadata};
use burn::tensor::{Shape, Tensor};
use cubecl::prelude::*;

/// Most parts that the values of a channel are split into; each is summed by a cube.
const MOST_PARTS: usize = 32;

/// Values of a part, at least.
const LEAST_OF_PART: usize = 2048;

/// Sums over the parts of each channel, [C, parts]: a cube for each part (x) of each channel (y). If `centred`, of the
/// squares of what is left without the mean, whose sums are given.
#[cube(launch)]
fn sums(x: &[f32], of_mean: &[f32], out: &mut [f32], frames: u32, pixels: u32, #[comptime] centred: bool) {
    let (part, channel) = (CUBE_POS_X as usize, CUBE_POS_Y as usize);
    let (parts, channels) = (CUBE_COUNT_X as usize, CUBE_COUNT_Y as usize);
    let values = (frames * pixels) as usize;
    let mut mean = 0.0f32;
    if comptime!(centred) {
        mean = sum_of_parts(of_mean, channel, parts) / f32::cast_from(values);
    }
    let of_part = values.div_ceil(parts);
    let mut i = part * of_part + UNIT_POS as usize;
    let end = end_of(part, of_part, values);
    let mut sum = 0.0f32;
    while i < end {
        let value = x[place(i, channel, channels, pixels as usize)];
        if comptime!(centred) {
            sum += (value - mean) * (value - mean);
        } else {
            sum += value;
        }
        i += CUBE_DIM as usize;
    }
    let sum = sum_of_cube(sum);
    if UNIT_POS == 0 {
        out[channel * parts + part] = sum;
    }
}

/// Mean and variance of each channel: a unit for each.
#[cube(launch)]
fn moments(sums: &[f32], squares: &[f32], mean: &mut [f32], variance: &mut [f32], values: u32, parts: u32) {
    let channel = ABSOLUTE_POS;
    if channel < mean.len() {
        mean[channel] = sum_of_parts(sums, channel, parts as usize) / f32::cast_from(values);
        variance[channel] = sum_of_parts(squares, channel, parts as usize) / f32::cast_from(values);
    }
}

/// A unit for each value. Of rows a value is a pixel.
#[cube(launch)]
pub(super) fn normalise(
    x: &[f32],
    mean: &[f32],
    variance: &[f32],
    gamma: &[f32],
    beta: &[f32],
    y: &mut [f32],
    epsilon: f32,
    pixels: u32,
    #[comptime] relu: bool,
) {
    let i = ABSOLUTE_POS;
    if i < x.len() {
        let channel = i / pixels as usize % mean.len();
        let scale = gamma[channel] / (variance[channel] + epsilon).sqrt();
        y[i] = rectified((x[i] - mean[channel]) * scale + beta[channel], relu);
    }
}

/// Sums of the gradient, and of its products with the normalised values, over the parts of each channel.
#[cube(launch)]
fn gradient_sums(
    x: &[f32],
    dy: &[f32],
    mean: &[f32],
    variance: &[f32],
    gamma: &[f32],
    beta: &[f32],
    plain: &mut [f32],
    by_value: &mut [f32],
    epsilon: f32,
    frames: u32,
    pixels: u32,
    #[comptime] relu: bool,
) {
    let (part, channel) = (CUBE_POS_X as usize, CUBE_POS_Y as usize);
    let (parts, channels) = (CUBE_COUNT_X as usize, CUBE_COUNT_Y as usize);
    let values = (frames * pixels) as usize;
    let inverse = 1.0 / (variance[channel] + epsilon).sqrt();
    let (mean, gamma, beta) = (mean[channel], gamma[channel], beta[channel]);
    let of_part = values.div_ceil(parts);
    let mut i = part * of_part + UNIT_POS as usize;
    let end = end_of(part, of_part, values);
    let mut sum = 0.0f32;
    let mut product = 0.0f32;
    while i < end {
        let at = place(i, channel, channels, pixels as usize);
        let centred = x[at] - mean;
        let d = passed(dy[at], centred * (gamma * inverse) + beta, relu);
        sum += d;
        product += d * (centred * inverse);
        i += CUBE_DIM as usize;
    }
    let sum = sum_of_cube(sum);
    sync_cube();
    let product = sum_of_cube(product);
    if UNIT_POS == 0 {
        plain[channel * parts + part] = sum;
        by_value[channel * parts + part] = product;
    }
}

/// The gradient by each value.
#[cube(launch)]
fn gradient(
    x: &[f32],
    dy: &[f32],
    mean: &[f32],
    variance: &[f32],
    gamma: &[f32],
    beta: &[f32],
    dgamma: &[f32],
    dbeta: &[f32],
    dx: &mut [f32],
    epsilon: f32,
    values: u32,
    pixels: u32,
    #[comptime] relu: bool,
) {
    let i = ABSOLUTE_POS;
    if i < x.len() {
        let channel = i / pixels as usize % mean.len();
        let inverse = 1.0 / (variance[channel] + epsilon).sqrt();
        let centred = x[i] - mean[channel];
        let d = passed(dy[i], centred * (gamma[channel] * inverse) + beta[channel], relu);
        let common = (dbeta[channel] + centred * inverse * dgamma[channel]) / f32::cast_from(values);
        dx[i] = gamma[channel] * inverse * (d - common);
    }
}

/// The sum of the parts of each channel.
#[cube(launch)]
fn totals(a: &[f32], b: &[f32], of_a: &mut [f32], of_b: &mut [f32], parts: u32) {
    let channel = ABSOLUTE_POS;
    if channel < of_a.len() {
        of_a[channel] = sum_of_parts(a, channel, parts as usize);
        of_b[channel] = sum_of_parts(b, channel, parts as usize);
    }
}

/// Shape and options.
#[derive(Clone, Copy, Debug)]
struct Norm {
    frames: usize,
    channels: usize,
    pixels: usize,
    epsilon: f32,
    relu: bool,
}

/// Mean and variance of a batch.
type Moments = [Primitive; 2];

impl Norm {
    fn values(&self) -> usize {
        self.frames * self.pixels
    }

    fn parts(&self) -> usize {
        (self.values() / LEAST_OF_PART).clamp(1, MOST_PARTS)
    }

    fn grid(&self) -> CubeCount {
        CubeCount::Static(self.parts() as u32, self.channels as u32, 1)
    }

    /// One number for each part of each channel, not set.
    fn of_parts(&self, like: &Primitive) -> Primitive {
        let shape = Shape::from([self.channels, self.parts()]);
        Cube::float_empty(shape, &like.device, like.dtype().into())
    }

    fn forward(&self, x: &Primitive, gamma: &Primitive, beta: &Primitive) -> (Primitive, Moments) {
        let Norm { frames, channels, pixels, epsilon, relu } = *self;
        let (units, parts) = (CubeDim::new_1d(UNITS), self.parts() as u32);
        let (frames, values, client) = (frames as u32, self.values() as u32, &x.client);
        let [of_parts, squares] = [(); 2].map(|()| self.of_parts(x));
        let [mean, variance] = [(); 2].map(|()| unset_like(gamma));
        let y = unset_like(x);
        for (of_mean, to, centred) in [(x, &of_parts, false), (&of_parts, &squares, true)] {
            let [x, of_mean, to] = [x, of_mean, to].map(argument);
            sums::launch(client, self.grid(), units, x, of_mean, to, frames, pixels as u32, centred);
        }
        let [of_parts, squares, to_mean, to_variance] = [&of_parts, &squares, &mean, &variance].map(argument);
        moments::launch(client, cubes(channels), units, of_parts, squares, to_mean, to_variance, values, parts);
        let [x, means, variances, gamma, beta, to] = [x, &mean, &variance, gamma, beta, &y].map(argument);
        let all = cubes(self.values() * channels);
        normalise::launch(client, all, units, x, means, variances, gamma, beta, to, epsilon, pixels as u32, relu);
        (y, [mean, variance])
    }

    /// The gradients by values, gamma and beta.
    fn backward(
        &self,
        [x, gamma, beta]: &[Primitive; 3],
        [mean, variance]: &Moments,
        dy: &Primitive,
    ) -> [Primitive; 3] {
        let Norm { frames, channels, pixels, epsilon, relu } = *self;
        let (units, parts, pixels) = (CubeDim::new_1d(UNITS), self.parts() as u32, pixels as u32);
        let (values, client) = (self.values() as u32, &x.client);
        let [plain, by_value] = [(); 2].map(|()| self.of_parts(x));
        let [dgamma, dbeta] = [(); 2].map(|()| unset_like(gamma));
        let dx = unset_like(x);
        let inputs = || [x, dy, mean, variance, gamma, beta].map(argument);
        let [a, b, c, d, e, f] = inputs();
        let [to_plain, to_product] = [&plain, &by_value].map(argument);
        let frames = frames as u32;
        gradient_sums::launch(
            client,
            self.grid(),
            units,
            a,
            b,
            c,
            d,
            e,
            f,
            to_plain,
            to_product,
            epsilon,
            frames,
            pixels,
            relu,
        );
        let [plain, by_value, to_beta, to_gamma] = [&plain, &by_value, &dbeta, &dgamma].map(argument);
        totals::launch(client, cubes(channels), units, plain, by_value, to_beta, to_gamma, parts);
        let [a, b, c, d, e, f] = inputs();
        let [by_gamma, by_beta, to] = [&dgamma, &dbeta, &dx].map(argument);
        let all = cubes(self.values() * channels);
        gradient::launch(client, all, units, a, b, c, d, e, f, by_gamma, by_beta, to, epsilon, values, pixels, relu);
        [dx, dgamma, dbeta]
    }
}

impl Backward<Cube, 3> for Norm {
    /// Inputs and statistics.
    type State = ([Primitive; 3], Moments);

    fn backward(self, ops: Ops<Self::State, 3>, grads: &mut Gradients, _: &mut Checkpointer) {
        let dy = plain(grads.consume::<Cube>(&ops.node));
        let (inputs, moments) = &ops.state;
        let gradients = Norm::backward(&self, inputs, moments, &dy);
        register(&ops, gradients, grads);
    }
}

/// The same values without gaps.
pub(super) fn plain(tensor: Primitive) -> Primitive {
    if is_plain(&tensor) {
        return tensor;
    }
    let copy = Cube::float_empty(tensor.shape(), &tensor.device, tensor.dtype().into());
    let all: Vec<burn::tensor::Slice> = tensor.shape().iter().map(|&size| (0..size).into()).collect();
    Cube::float_slice_assign(copy, &all, tensor)
}

/// The normalised batch, with a ReLU if `relu`, and its statistics. `None` for tensors that are not on a GPU, or
/// without autodiff graph.
///
/// # Shapes
/// `x` and result: `[B, C, ...]`; `gamma`, `beta`: `[C]`.
pub fn norm_relu<const D: usize>(
    x: &Tensor<D>,
    gamma: &Tensor<1>,
    beta: &Tensor<1>,
    epsilon: f64,
    relu: bool,
) -> Option<(Tensor<D>, layers::Moments)> {
    let shape = x.dims();
    let norm = Norm {
        frames: shape[0],
        channels: shape[1],
        pixels: shape[2..].iter().product(),
        epsilon: epsilon as f32,
        relu,
    };
    let (inputs, nodes) = tracked_inputs(x, gamma, beta)?;
    if norm.channels >= 1 << 16 {
        return None;
    }
    let (y, moments) = norm.forward(&inputs[0], &inputs[1], &inputs[2]);
    let [mean, variance] = moments.clone().map(Tensor::from_primitive::<Cube>);
    let y = tracked(norm, nodes, (inputs, moments), y);
    Some((y, layers::Moments { mean, variance, count: norm.values() }))
}

/// A tensor with autodiff graph on a GPU.
type Tracked = Autodiff<Cube, NoCheckpointing>;

/// The inputs of a norm without gaps, and their nodes; `None` for tensors that no kernel takes.
pub(super) fn tracked_inputs<const D: usize>(
    x: &Tensor<D>,
    gamma: &Tensor<1>,
    beta: &Tensor<1>,
) -> Option<([Primitive; 3], [NodeGuard; 3])> {
    let x = x.clone().try_into_primitive::<Tracked>().ok()?;
    let [gamma, beta] = [gamma, beta].map(|tensor| tensor.clone().try_into_primitive::<Tracked>().ok());
    let parts = [x, gamma?, beta?].map(|tensor| tensor.into_parts());
    let inputs = parts.each_ref().map(|(tensor, _)| plain(tensor.clone()));
    let is_supported = inputs.iter().all(is_plain) && inputs[0].shape().num_elements() < 1 << 32;
    is_supported.then(|| (inputs, parts.map(|(_, node)| node)))
}

/// The result of an operation, with its place in the autodiff graph.
pub(super) fn tracked<O: Backward<Cube, N>, const N: usize, const D: usize>(
    operation: O,
    nodes: [NodeGuard; N],
    state: O::State,
    y: Primitive,
) -> Tensor<D> {
    Tensor::from_primitive::<Tracked>(match operation.prepare::<NoCheckpointing>(nodes).compute_bound().stateful() {
        OpsKind::Tracked(prepared) => prepared.finish(state, y),
        OpsKind::UnTracked(prepared) => prepared.finish(y),
    })
}

/// Hands the gradients to those inputs that have one.
pub(super) fn register<S>(ops: &Ops<S, 3>, gradients: [Primitive; 3], grads: &mut Gradients) {
    for (parent, gradient) in ops.parents.iter().zip(gradients) {
        if let Some(parent) = parent {
            grads.register::<Cube>(parent.id, gradient);
        }
    }
}
