//! Pillar feature net (OpenPCDet: `PillarVFE` with one layer): linear without bias, batch norm, ReLU, maximum over the
//! points of a pillar.
//!
//! The reference pads every pillar with zero rows up to `max_points`. These rows count in the statistics and in the
//! maximum. Here only the points are read: a zero row is zero after the linear layer, so its contribution is known.
//!
//! The linear layer's output y = w x is never stored. Its mean w S / n and variance w M w^T / n - mean^2 follow from
//! the sum S of the inputs and the sum M of their outer products, and so do the terms of the gradient that are equal
//! for all rows. Sums are f64, because coordinates in metres cause cancellation in f32.

mod backward;
mod maximum;
mod moments;

use crate::batch_norm::{Statistics, non_negative};
use crate::output::{Shared, fill};
use crate::simd::dispatch;
use maximum::Maximum;
use moments::Moments;
use rayon::prelude::*;

/// Largest number of values a point.
pub const MOST_INPUTS: usize = 16;

/// Number of parts that the pillars are divided into, for any number of threads.
const PARTS: usize = 32;

/// Source of an output: no row, since the ReLU made it zero.
const NOWHERE: u32 = u32::MAX;
/// Source of an output: a padding row.
const PADDING: u32 = u32::MAX - 1;

/// The shape of the pillar feature net.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PillarNet {
    /// Values of a point, F, at most [`MOST_INPUTS`].
    pub inputs: usize,
    /// Features of a pillar, C.
    pub outputs: usize,
    /// Rows of a padded pillar in the reference.
    pub max_points: usize,
    /// Added to the variance.
    pub epsilon: f64,
}

/// The points of all pillars, sorted by pillar.
#[derive(Clone, Copy, Debug)]
pub struct Pillars<'a> {
    /// `[N, F]`.
    pub features: &'a [f32],
    /// Points in each pillar, `[P]`; their sum is N.
    pub num_points: &'a [u32],
}

/// Learned parameters.
#[derive(Clone, Copy, Debug)]
pub struct PillarParameters<'a> {
    /// `[C, F]`.
    pub weight: &'a [f32],
    /// Scale of the batch norm, `[C]`.
    pub gamma: &'a [f32],
    /// Shift of the batch norm, `[C]`.
    pub beta: &'a [f32],
}

/// What the backward pass needs of the forward pass.
#[derive(Clone, Debug)]
pub struct PillarState {
    /// Mean and variance over all rows, the padding included; zero without rows.
    pub statistics: Statistics,
    /// Number of these rows.
    pub count: usize,
    moments: Moments,
    /// The row that each output comes from, `[P, C]`.
    argmax: Vec<u32>,
}

/// Gradients with respect to the parameters.
#[derive(Clone, Debug, PartialEq)]
pub struct PillarGradients {
    /// `[C, F]`.
    pub weight: Vec<f32>,
    /// `[C]`.
    pub gamma: Vec<f32>,
    /// `[C]`.
    pub beta: Vec<f32>,
}

impl PillarNet {
    /// Forward pass with the statistics of the points and the padding. `out`, `[P, C]`, is overwritten.
    pub fn forward_train(
        &self,
        pillars: Pillars<'_>,
        parameters: PillarParameters<'_>,
        out: &mut Vec<f32>,
    ) -> PillarState {
        let starts = self.check(&pillars, &parameters);
        let moments = Moments::of(pillars.features, self.inputs, PARTS);
        let count = pillars.num_points.len() * self.max_points;
        let statistics = self.statistics(&moments, parameters.weight, count);
        let argmax = self.maximum(&pillars, &starts, parameters, &statistics, out);
        PillarState { statistics, count, moments, argmax }
    }

    /// Forward pass with given statistics. `out`, `[P, C]`, is overwritten.
    pub fn forward(
        &self,
        pillars: Pillars<'_>,
        parameters: PillarParameters<'_>,
        statistics: &Statistics,
        out: &mut Vec<f32>,
    ) {
        let starts = self.check(&pillars, &parameters);
        self.maximum(&pillars, &starts, parameters, statistics, out);
    }

    /// Gradients with respect to the parameters from the gradient with respect to the outputs, `[P, C]`. None is
    /// computed for the points.
    pub fn backward(
        &self,
        pillars: Pillars<'_>,
        parameters: PillarParameters<'_>,
        state: &PillarState,
        dout: &[f32],
    ) -> PillarGradients {
        let starts = self.check(&pillars, &parameters);
        assert_eq!(dout.len(), pillars.num_points.len() * self.outputs, "elements of dout of {self:?}");
        backward::backward(self, pillars.features, &starts, parameters, state, dout)
    }

    /// The first row of each pillar, and N.
    fn check(&self, pillars: &Pillars<'_>, parameters: &PillarParameters<'_>) -> Vec<usize> {
        assert!(self.inputs <= MOST_INPUTS, "more than {MOST_INPUTS} values a point: {self:?}");
        assert_eq!(parameters.weight.len(), self.outputs * self.inputs, "elements of the weights of {self:?}");
        assert_eq!((parameters.gamma.len(), parameters.beta.len()), (self.outputs, self.outputs), "norm of {self:?}");
        let mut starts = vec![0];
        for &n in pillars.num_points {
            assert!(n as usize <= self.max_points, "{n} points in a pillar of {self:?}");
            starts.push(starts[starts.len() - 1] + n as usize);
        }
        assert_eq!(
            pillars.features.len(),
            starts[starts.len() - 1] * self.inputs,
            "elements of the points of {self:?}"
        );
        starts
    }

    fn statistics(&self, moments: &Moments, weight: &[f32], count: usize) -> Statistics {
        if count == 0 {
            return Statistics { mean: vec![0.0; self.outputs], variance: vec![0.0; self.outputs] };
        }
        let n = count as f64;
        let of = |weight: &[f32]| {
            let mean = moments.sum_along(weight) / n;
            (mean, non_negative(moments.square_along(weight) / n - mean * mean))
        };
        let (mean, variance) = weight.chunks_exact(self.inputs.max(1)).map(of).unzip();
        Statistics { mean, variance }
    }

    /// Writes the outputs and returns the row that each comes from.
    fn maximum(
        &self,
        pillars: &Pillars<'_>,
        starts: &[usize],
        parameters: PillarParameters<'_>,
        statistics: &Statistics,
        out: &mut Vec<f32>,
    ) -> Vec<u32> {
        let count = pillars.num_points.len();
        let maximum = Maximum::new(self, parameters, statistics);
        let mut argmax = vec![NOWHERE; count * self.outputs];
        if argmax.is_empty() {
            out.clear();
            return argmax;
        }
        let pillars_a_part = count.div_ceil(PARTS);
        // SAFETY: the parts cover all pillars.
        unsafe {
            fill(out, count * self.outputs, |out| {
                let out = Shared::new(out);
                argmax.par_chunks_mut(pillars_a_part * self.outputs).enumerate().for_each(|(part, argmax)| {
                    let first = part * pillars_a_part;
                    let starts = &starts[first..=first + argmax.len() / self.outputs];
                    dispatch(maximum.over(pillars.features, starts, argmax, |pillar, channel, values| {
                        // SAFETY: each pillar is in one part.
                        out.write((first + pillar) * self.outputs + channel, values);
                    }));
                });
            });
        }
        argmax
    }
}

#[cfg(test)]
mod tests;
