//! Sums over rows, and batch normalisation of rows, optionally with a ReLU.

use super::norm_relu::{normalise, plain, register, tracked, tracked_inputs};
use super::units::{end_of, passed};
use super::{Primitive, UNITS, argument, cubes, is_plain, unset_like};
use crate::layers::Moments;
use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::NoCheckpointing;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops};
use burn::backend::ops::FloatTensorOps;
use burn::backend::tensor::IntTensor;
use burn::backend::{Autodiff, Cube, TensorMetadata};
use burn::tensor::{Shape, Tensor};
use cubecl::prelude::*;

/// Channels that a cube sums side by side. As many units as there are rows side by side share a channel.
const CHANNELS_OF_CUBE: usize = 32;

/// Most parts that the rows are split into.
const MOST_PARTS: usize = 256;

/// Rows of a part, at least.
const LEAST_OF_PART: usize = 256;

/// What is summed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
enum Terms {
    Values,
    /// Values times the multiplicity of their rows.
    Counted,
    /// Squares of what is left without the mean, times the multiplicity.
    CentredSquares,
}

/// The sum over the units of a cube that share a channel, for the first of them.
#[cube]
fn sum_of_lanes(value: f32) -> f32 {
    let mut sums = Shared::<[f32]>::new_slice(256usize);
    let unit = UNIT_POS as usize;
    sums[unit] = value;
    sync_cube();
    let mut sum = 0.0f32;
    if unit < 32 {
        for lane in 0..8usize {
            sum += sums[lane * 32 + unit];
        }
    }
    sum
}

/// Sums over parts of the rows, times a factor, [parts, C]: a cube for each part (x) and 32 channels (y).
#[cube(launch)]
fn row_sums(
    x: &[f32],
    counts: &[f32],
    mean: &[f32],
    out: &mut [f32],
    rows: u32,
    channels: u32,
    factor: f32,
    #[comptime] terms: Terms,
) {
    let (rows, channels) = (rows as usize, channels as usize);
    let channel = CUBE_POS_Y as usize * 32 + UNIT_POS as usize % 32;
    let of_part = rows.div_ceil(CUBE_COUNT_X as usize);
    let mut row = CUBE_POS_X as usize * of_part + UNIT_POS as usize / 32;
    let end = end_of(CUBE_POS_X as usize, of_part, rows);
    let mut sum = 0.0f32;
    if channel < channels {
        while row < end {
            let value = x[row * channels + channel];
            if comptime!(terms == Terms::Values) {
                sum += value;
            }
            if comptime!(terms == Terms::Counted) {
                sum += value * counts[row];
            }
            if comptime!(terms == Terms::CentredSquares) {
                let centred = value - mean[channel];
                sum += centred * centred * counts[row];
            }
            row += 8;
        }
    }
    let sum = sum_of_lanes(sum);
    if UNIT_POS < 32 && channel < channels {
        out[CUBE_POS_X as usize * channels + channel] = sum * factor;
    }
}

/// The gradient where the ReLU lets it through, and its product with the normalised value.
#[cube(launch)]
fn passed_gradients(
    x: &[f32],
    dy: &[f32],
    mean: &[f32],
    variance: &[f32],
    gamma: &[f32],
    beta: &[f32],
    gradient: &mut [f32],
    by_value: &mut [f32],
    epsilon: f32,
    #[comptime] relu: bool,
) {
    let i = ABSOLUTE_POS;
    if i < x.len() {
        let channel = i % mean.len();
        let inverse = 1.0 / (variance[channel] + epsilon).sqrt();
        let centred = x[i] - mean[channel];
        let d = passed(dy[i], centred * (gamma[channel] * inverse) + beta[channel], relu);
        gradient[i] = d;
        by_value[i] = d * (centred * inverse);
    }
}

/// The gradient by each value.
#[cube(launch)]
fn gradient_of_rows(
    x: &[f32],
    passed: &[f32],
    counts: &[f32],
    mean: &[f32],
    variance: &[f32],
    gamma: &[f32],
    dgamma: &[f32],
    dbeta: &[f32],
    dx: &mut [f32],
    epsilon: f32,
    total: f32,
) {
    let i = ABSOLUTE_POS;
    if i < x.len() {
        let channel = i % mean.len();
        let inverse = 1.0 / (variance[channel] + epsilon).sqrt();
        let value = (x[i] - mean[channel]) * inverse;
        let common = (dbeta[channel] + value * dgamma[channel]) * (counts[i / mean.len()] / total);
        dx[i] = gamma[channel] * inverse * (passed[i] - common);
    }
}

/// Sums over rows times a factor, `[1, C]`.
fn sums(x: &Primitive, (counts, mean): (&Primitive, &Primitive), factor: f32, terms: Terms) -> Primitive {
    let [rows, channels] = x.shape().dims();
    let parts = (rows / LEAST_OF_PART).clamp(1, MOST_PARTS);
    let launch = |x: &Primitive, parts: usize, factor: f32, terms: Terms| {
        let out = Cube::float_empty(Shape::from([parts, channels]), &x.device, x.dtype().into());
        let grid = CubeCount::Static(parts as u32, channels.div_ceil(CHANNELS_OF_CUBE) as u32, 1);
        let (rows, channels) = (x.shape()[0] as u32, channels as u32);
        let [of, counts, mean, to] = [x, counts, mean, &out].map(argument);
        row_sums::launch(&x.client, grid, CubeDim::new_1d(UNITS), of, counts, mean, to, rows, channels, factor, terms);
        out
    };
    if parts == 1 {
        return launch(x, 1, factor, terms);
    }
    launch(&launch(x, parts, 1.0, terms), 1, factor, Terms::Values)
}

/// The sum over all rows. `None` for another precision than single, or no rows.
///
/// # Shapes
/// `x`: `[N, C]`; result `[1, C]`.
pub(crate) fn sum_of_rows(x: &Primitive) -> Option<Primitive> {
    let x = plain(x.clone());
    is_plain(&x).then(|| sums(&x, (&x, &x), 1.0, Terms::Values))
}

/// Options.
#[derive(Clone, Copy, Debug)]
struct Norm {
    /// Sum of the multiplicities.
    total: f32,
    epsilon: f32,
    relu: bool,
}

#[derive(Clone, Debug)]
struct State {
    x: Primitive,
    counts: Primitive,
    gamma: Primitive,
    beta: Primitive,
    mean: Primitive,
    variance: Primitive,
}

impl Norm {
    fn forward(&self, [x, gamma, beta]: [Primitive; 3], counts: Primitive) -> (Primitive, State) {
        let channels = gamma.shape()[0];
        let flat = |sum: Primitive| Cube::float_reshape(sum, Shape::from([channels]));
        let share = 1.0 / self.total;
        let mean = flat(sums(&x, (&counts, &x), share, Terms::Counted));
        let variance = flat(sums(&x, (&counts, &mean), share, Terms::CentredSquares));
        let y = unset_like(&x);
        let all = cubes(x.shape().num_elements());
        let [of, means, variances, gammas, betas, to] = [&x, &mean, &variance, &gamma, &beta, &y].map(argument);
        let (units, epsilon, relu) = (CubeDim::new_1d(UNITS), self.epsilon, self.relu);
        normalise::launch(&x.client, all, units, of, means, variances, gammas, betas, to, epsilon, 1, relu);
        (y, State { x, counts, gamma, beta, mean, variance })
    }

    /// The gradients by values, gamma and beta.
    fn backward(&self, state: &State, dy: &Primitive) -> [Primitive; 3] {
        let State { x, counts, gamma, beta, mean, variance } = state;
        let [passed, by_value, dx] = [(); 3].map(|()| unset_like(x));
        let (units, epsilon) = (CubeDim::new_1d(UNITS), self.epsilon);
        let all = || cubes(x.shape().num_elements());
        let [a, b, c, d, e, f, g, h] = [x, dy, mean, variance, gamma, beta, &passed, &by_value].map(argument);
        passed_gradients::launch(&x.client, all(), units, a, b, c, d, e, f, g, h, epsilon, self.relu);
        let [dbeta, dgamma] = [&passed, &by_value].map(|terms| {
            let sum = sums(terms, (terms, terms), 1.0, Terms::Values);
            Cube::float_reshape(sum, gamma.shape())
        });
        let [a, b, c, d, e, f, g, h, i] =
            [x, &passed, counts, mean, variance, gamma, &dgamma, &dbeta, &dx].map(argument);
        gradient_of_rows::launch(&x.client, all(), units, a, b, c, d, e, f, g, h, i, epsilon, self.total);
        [dx, dgamma, dbeta]
    }
}

impl Backward<Cube, 3> for Norm {
    type State = State;

    fn backward(self, ops: Ops<Self::State, 3>, grads: &mut Gradients, _: &mut Checkpointer) {
        let dy = plain(grads.consume::<Cube>(&ops.node));
        let gradients = Norm::backward(&self, &ops.state, &dy);
        register(&ops, gradients, grads);
    }
}

/// Rows normalised with their statistics, with a ReLU if `relu`. `None` for tensors that are not on a GPU, or without
/// autodiff graph.
///
/// # Shapes
/// `x` and result: `[N, C]`; `gamma`, `beta`: `[C]`; `counts`: the multiplicity of each row in the statistics, `[N]`,
/// and their sum.
pub fn norm_relu_rows(
    x: &Tensor<2>,
    (gamma, beta): (&Tensor<1>, &Tensor<1>),
    (counts, total): (&Tensor<1>, usize),
    epsilon: f64,
    relu: bool,
) -> Option<(Tensor<2>, Moments)> {
    let norm = Norm { total: total.max(1) as f32, epsilon: epsilon as f32, relu };
    let (inputs, nodes) = tracked_inputs(x, gamma, beta)?;
    let counts = match counts.clone().try_into_primitive::<Autodiff<Cube, NoCheckpointing>>() {
        Ok(tracked) => tracked.into_parts().0,
        Err(_) => counts.clone().try_into_primitive::<Cube>().ok()?,
    };
    let counts = plain(counts);
    if !is_plain(&counts) {
        return None;
    }
    let (y, state) = norm.forward(inputs, counts);
    let [mean, variance] = [&state.mean, &state.variance].map(|t| Tensor::from_primitive::<Cube>(t.clone()));
    Some((tracked(norm, nodes, state, y), Moments { mean, variance, count: total }))
}

/// Rows that go somewhere: a unit for each value.
#[cube(launch_unchecked)]
fn place(x: &[f32], rows: &[i32], places: &[i32], out: &mut [f32], channels: u32, values: u32) {
    let i = ABSOLUTE_POS;
    let channels = channels as usize;
    if i < values as usize {
        let (row, channel) = (i / channels, i % channels);
        out[places[row] as usize * channels + channel] = x[rows[row] as usize * channels + channel];
    }
}

/// Rows of `x` at their places, which are distinct, among rows of zeros. `None` for another precision than single, or
/// gaps.
///
/// # Shapes
/// `x`: `[N, C]`; `rows` and `places`: as many; result `[count, C]`.
pub(crate) fn place_rows(x: &Primitive, [rows, places]: [&IntTensor<Cube>; 2], count: usize) -> Option<Primitive> {
    let channels = x.shape()[1];
    let values = rows.shape()[0] * channels;
    if !is_plain(x) || values == 0 || count * channels >= 1 << 32 || values >= 1 << 32 {
        return None;
    }
    let out = Cube::float_zeros(Shape::from([count, channels]), &x.device, x.dtype().into());
    // SAFETY: rows are below N and places below `count`.
    unsafe {
        place::launch_unchecked(
            &x.client,
            cubes(values),
            CubeDim::new_1d(UNITS),
            argument(x),
            argument(rows),
            argument(places),
            argument(&out),
            channels as u32,
            values as u32,
        );
    }
    Some(out)
}
