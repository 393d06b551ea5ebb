//! The maximum over the points of a pillar, with the batch norm folded into the linear layer.

use super::{MOST_INPUTS, NOWHERE, PADDING, PillarNet, PillarParameters};
use crate::batch_norm::Statistics;
use crate::simd::multiply_add;
use pulp::{Simd, WithSimd};

/// Channels that are processed together.
const GROUP: usize = 16;

/// Weights and bias of a group of channels, `[groups]` of `[F, GROUP]` and `[GROUP]`; padded with zeros after the last
/// channel.
pub(super) struct Maximum {
    inputs: usize,
    outputs: usize,
    max_points: usize,
    weights: Vec<[[f32; GROUP]; MOST_INPUTS]>,
    bias: Vec<[f32; GROUP]>,
}

impl Maximum {
    pub fn new(net: &PillarNet, parameters: PillarParameters<'_>, statistics: &Statistics) -> Self {
        let groups = net.outputs.div_ceil(GROUP);
        let mut weights = vec![[[0.0; GROUP]; MOST_INPUTS]; groups];
        let mut bias = vec![[0.0; GROUP]; groups];
        for channel in 0..net.outputs {
            let (group, lane) = (channel / GROUP, channel % GROUP);
            let (mean, variance) = (statistics.mean[channel], statistics.variance[channel]);
            let scale = parameters.gamma[channel] as f64 / (variance + net.epsilon).sqrt();
            bias[group][lane] = (parameters.beta[channel] as f64 - mean * scale) as f32;
            for (k, &w) in parameters.weight[channel * net.inputs..][..net.inputs].iter().enumerate() {
                weights[group][k][lane] = (w as f64 * scale) as f32;
            }
        }
        Maximum { inputs: net.inputs, outputs: net.outputs, max_points: net.max_points, weights, bias }
    }

    /// Processes the pillars whose first rows are in `starts`; the result goes to `write(pillar, channel, values)`.
    pub fn over<'a, W: Fn(usize, usize, &[f32])>(
        &'a self,
        features: &'a [f32],
        starts: &'a [usize],
        argmax: &'a mut [u32],
        write: W,
    ) -> OverPillars<'a, W> {
        OverPillars { maximum: self, features, starts, argmax, write }
    }
}

pub(super) struct OverPillars<'a, W> {
    maximum: &'a Maximum,
    features: &'a [f32],
    starts: &'a [usize],
    argmax: &'a mut [u32],
    write: W,
}

impl<W: Fn(usize, usize, &[f32])> WithSimd for OverPillars<'_, W> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Maximum { inputs, outputs, max_points, .. } = *self.maximum;
        for (pillar, (ends, argmax)) in self.starts.windows(2).zip(self.argmax.chunks_exact_mut(outputs)).enumerate() {
            let points = ends[0]..ends[1];
            let padded = points.len() < max_points;
            let rows = &self.features[points.start * inputs..points.end * inputs];
            let groups = self.maximum.weights.iter().zip(&self.maximum.bias).zip(argmax.chunks_mut(GROUP));
            for (group, ((weights, bias), argmax)) in groups.enumerate() {
                let (mut values, mut places) = ([0.0; GROUP], [NOWHERE; GROUP]);
                for part in 0..GROUP / S::F32_LANES {
                    let mut registers = [simd.splat_f32s(0.0); MOST_INPUTS];
                    for (register, weights) in registers.iter_mut().zip(weights) {
                        *register = S::as_simd_f32s(weights).0[part];
                    }
                    let bias = S::as_simd_f32s(bias).0[part];
                    // The ReLU: the maximum starts at zero.
                    let mut best = simd.splat_f32s(0.0);
                    let mut place = simd.splat_u32s(NOWHERE);
                    if padded {
                        (best, place) = larger(simd, (best, place), (bias, PADDING));
                    }
                    for (row, x) in rows.chunks_exact(inputs).enumerate() {
                        let mut y = bias;
                        for (&x, &weight) in x.iter().zip(&registers) {
                            y = multiply_add(simd, simd.splat_f32s(x), weight, y);
                        }
                        (best, place) = larger(simd, (best, place), (y, (points.start + row) as u32));
                    }
                    S::as_mut_simd_f32s(&mut values).0[part] = best;
                    S::as_mut_simd_u32s(&mut places).0[part] = place;
                }
                (self.write)(pillar, group * GROUP, &values[..argmax.len()]);
                argmax.copy_from_slice(&places[..argmax.len()]);
            }
        }
    }
}

/// The larger of two values and its row; the first one of equal values. NaN propagates.
#[inline(always)]
fn larger<S: Simd>(
    simd: S,
    (best, place): (S::f32s, S::u32s),
    (value, its_place): (S::f32s, u32),
) -> (S::f32s, S::u32s) {
    let is_nan = simd.not_m32s(simd.equal_f32s(value, value));
    let takes = simd.or_m32s(simd.greater_than_f32s(value, best), is_nan);
    (simd.select_f32s(takes, value, best), simd.select_u32s(takes, simd.splat_u32s(its_place), place))
}
