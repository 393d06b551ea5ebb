//! Pillar feature net (OpenPCDet: `PillarVFE` with one layer): linear without bias, batch norm, ReLU, maximum over the points of a pillar.
//!
//! The reference pads every pillar with zero rows up to `max_points`; these rows count in the statistics and take part in the maximum. Here
//! only the points themselves are read. A zero row stays zero behind the linear layer, so what it adds is known.
//!
//! The linear layer's output y = w x is never stored: its mean and variance follow from the sum and the products of the inputs, w S / n and
//! w M w^T / n - mean^2, and so do the parts of the gradient that are the same for all rows. Sums are in f64: in f32 metres cancel.

mod backward;
mod maximum;
mod moments;

use crate::batch_norm::{Statistics, non_negative};
use crate::output::{Shared, fill};
use crate::simd::dispatch;
use maximum::Maximum;
use moments::Moments;
use rayon::prelude::*;

/// Values of a point at most.
pub const MOST_INPUTS: usize = 16;

/// Parts that the pillars are cut into, whatever the number of threads.
const PARTS: usize = 32;

/// Where an output comes from: no row, since the ReLU made it zero.
const NOWHERE: u32 = u32::MAX;
/// Where an output comes from: a padding row.
const PADDING: u32 = u32::MAX - 1;

/// The net.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PillarNet {
    /// Values of a point, F, at most [`MOST_INPUTS`].
    pub inputs: usize,
    /// Values of a pillar, C.
    pub outputs: usize,
    /// Rows that the reference pads a pillar to.
    pub max_points: usize,
    /// Added to the variance.
    pub epsilon: f64,
}

/// The points of all pillars, pillar after pillar.
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
    /// Mean and variance over all rows, the padding included; zero where there are none.
    pub statistics: Statistics,
    /// Number of these rows.
    pub count: usize,
    moments: Moments,
    /// The row that each output comes from, `[P, C]`.
    argmax: Vec<u32>,
}

/// Gradients by the parameters.
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
    /// With the statistics of the points and the padding. `out`, `[P, C]`, is overwritten, whatever it held.
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

    /// With given statistics. `out`, `[P, C]`, is overwritten, whatever it held.
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

    /// Gradients by the parameters from the gradient by the outputs, `[P, C]`. The points are data: there is none by them.
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
        assert!(self.inputs <= MOST_INPUTS, "at most {MOST_INPUTS} values a point: {self:?}");
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
                        // SAFETY: no other part has this pillar.
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
