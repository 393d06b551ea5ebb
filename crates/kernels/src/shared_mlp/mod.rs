//! Shared MLP (PointNet++'s set abstraction, feature propagation and heads): layers of linear without bias, batch norm and ReLU on rows, and
//! the maximum over groups of rows.
//!
//! Blocks of rows are worked on while they are in the cache. In training the rows of a layer before its batch norm are kept, but for the last
//! layer before a maximum.

mod dense;
mod norm;
mod pooling;
mod rows;

use crate::batch_norm::Statistics;
use crate::fold::{Folded, NormParameters};
use crate::matrix::{Matrix, Then, multiply};
use crate::output::{Shared, fill};
use crate::scratch;
use crate::simd::vectorized;
use dense::Layer;
use norm::{Norm, NormGradient};
use pooling::Extremes;
use rows::{Input, Rows};

/// The shape of a net.
#[derive(Clone, Debug, PartialEq)]
pub struct SharedMlp {
    /// Rows of `x`: groups times `group`.
    pub rows: usize,
    /// Rows that the maximum is taken over; with 1 there is none.
    pub group: usize,
    /// Channels: of `x`, and behind each layer.
    pub channels: Vec<usize>,
    /// Added to the variances.
    pub epsilon: f64,
}

/// Learned parameters of a layer.
#[derive(Clone, Copy, Debug)]
pub struct MlpLayer<'a> {
    /// `[outputs, inputs]`.
    pub weight: &'a [f32],
    /// Scale of the batch norm, `[outputs]`.
    pub gamma: &'a [f32],
    /// Shift of the batch norm, `[outputs]`.
    pub beta: &'a [f32],
}

/// What the backward pass needs of the forward pass.
#[derive(Clone, Debug)]
pub struct MlpState {
    /// Mean and variance of each layer; zero where there are no rows.
    pub statistics: Vec<Statistics>,
    /// The rows of each layer before the batch norm, but for the last before a maximum.
    hidden: Vec<Vec<f32>>,
    extremes: Option<Extremes>,
}

/// Gradients by the parameters of a layer.
#[derive(Clone, Debug, PartialEq)]
pub struct MlpGradients {
    /// `[outputs, inputs]`.
    pub weight: Vec<f32>,
    /// `[outputs]`.
    pub gamma: Vec<f32>,
    /// `[outputs]`.
    pub beta: Vec<f32>,
}

impl SharedMlp {
    /// Elements of the output, `[rows / group, channels of the last layer]`.
    pub fn out_len(&self) -> usize {
        self.rows / self.group * self.channels[self.channels.len() - 1]
    }

    /// Normalises by the statistics of the rows. `out`, `[rows / group, outputs]`, is overwritten, whatever it held.
    ///
    /// # Shapes
    /// `x`: `[rows, channels[0]]`, the rows of a group one after the other.
    pub fn forward_train(&self, x: &[f32], layers: &[MlpLayer<'_>], out: &mut Vec<f32>) -> MlpState {
        let rows = self.check(x, layers);
        let mut state = MlpState { statistics: Vec::new(), hidden: Vec::new(), extremes: None };
        let mut norms: Vec<Norm> = Vec::new();
        for (l, layer) in layers.iter().enumerate() {
            let input = self.input(x, &state.hidden, &norms, l);
            let statistics = if self.pools(l) {
                let (statistics, extremes) = pooling::forward(&rows, input, layer.weight, layer.gamma);
                state.extremes = Some(extremes);
                statistics
            } else {
                let mut y = Vec::new();
                let statistics = dense::forward(&rows, input, layer.weight, &mut y);
                state.hidden.push(y);
                statistics
            };
            norms.push(Norm::new(&statistics, layer.gamma, layer.beta, self.epsilon));
            state.statistics.push(statistics);
        }
        let norm = &norms[norms.len() - 1];
        match &state.extremes {
            Some(extremes) => pooling::output(extremes, norm, out),
            None => {
                let input = Input::Hidden { y: &state.hidden[layers.len() - 1], norm };
                self.write_rows(&rows, input, out);
            }
        }
        state
    }

    /// Gradients by the parameters of each layer, and by the rows, if `dx` is given: it is overwritten, whatever it held.
    ///
    /// # Shapes
    /// `x`, `dx`: `[rows, channels[0]]`; `dout`: `[rows / group, outputs]`.
    pub fn backward(
        &self,
        x: &[f32],
        layers: &[MlpLayer<'_>],
        state: &MlpState,
        dout: &[f32],
        mut dx: Option<&mut Vec<f32>>,
    ) -> Vec<MlpGradients> {
        let rows = self.check(x, layers);
        assert_eq!(dout.len(), self.out_len(), "elements of dout of {self:?}");
        let norm =
            |(layer, statistics): (&MlpLayer<'_>, _)| Norm::new(statistics, layer.gamma, layer.beta, self.epsilon);
        let norms: Vec<Norm> = layers.iter().zip(&state.statistics).map(norm).collect();
        let last = layers.len() - 1;
        let mut upstream = match &state.extremes {
            Some(extremes) => pooling::last(extremes, &norms[last], dout),
            None => dense::last(&rows, &state.hidden[last], &norms[last], dout),
        };
        let mut gradients = Vec::new();
        for l in (0..layers.len()).rev() {
            let (layer, statistics, norm) = (&layers[l], &state.statistics[l], &norms[l]);
            let gradient = NormGradient::new(&upstream.sums, self.rows, statistics, layer.gamma, self.epsilon);
            let input = self.input(x, &state.hidden, &norms, l);
            let wanted = l > 0 || dx.is_some();
            let (weight, before) = match &state.extremes {
                Some(extremes) if self.pools(l) => {
                    let parameters = (layer.weight, statistics, norm);
                    pooling::backward(&rows, input, parameters, (extremes, &upstream), &gradient, wanted)
                }
                _ => {
                    let layer = Layer { weight: layer.weight, y: &state.hidden[l], norm };
                    dense::backward(&rows, input, layer, &upstream, &gradient, wanted)
                }
            };
            gradients.push(MlpGradients { weight, gamma: gradient.gamma, beta: gradient.beta });
            upstream = before;
        }
        if let Some(dx) = &mut dx {
            **dx = upstream.gradient;
        }
        gradients.reverse();
        gradients
    }

    /// Normalises by given statistics, all layers of a block of rows at once. `out` is overwritten, whatever it held.
    ///
    /// # Shapes
    /// `x`: `[rows, channels[0]]`; `out`: `[rows / group, outputs]`.
    pub fn forward(&self, x: &[f32], layers: &[MlpLayer<'_>], statistics: &[Statistics], out: &mut Vec<f32>) {
        let rows = self.check(x, layers);
        let fold = |(layer, statistics): (&MlpLayer<'_>, &Statistics)| {
            let MlpLayer { weight, gamma, beta } = *layer;
            NormParameters { gamma, beta, statistics, epsilon: self.epsilon }.fold_into_conv(weight)
        };
        let folded: Vec<Folded> = layers.iter().zip(statistics).map(fold).collect();
        assert_eq!(folded.len(), layers.len(), "statistics of each layer of {self:?}");
        let widest = self.channels.iter().max().copied().unwrap_or(0);
        let outputs = self.channels[layers.len()];
        // SAFETY: the blocks cover all groups.
        unsafe {
            fill(out, self.out_len(), |out| {
                let out = Shared::new(out);
                rows.parts(|blocks| {
                    scratch::with([rows.block() * widest, rows.block() * widest, outputs], |[from, to, best]| {
                        let (mut from, mut to) = (from, to);
                        for block in blocks {
                            for (l, layer) in folded.iter().enumerate() {
                                let [inputs, outputs] = [self.channels[l], self.channels[l + 1]];
                                let input = match l {
                                    0 => &x[block.start * inputs..block.end * inputs],
                                    _ => &from[..block.len() * inputs],
                                };
                                let product = &mut to[..block.len() * outputs];
                                let weight = Matrix::new(&layer.weight, inputs).transposed();
                                multiply(Matrix::new(input, inputs), weight, product, Then::Store);
                                vectorized(|| bias_relu(product, &layer.bias));
                                std::mem::swap(&mut from, &mut to);
                            }
                            let values = &from[..block.len() * outputs];
                            for (k, group) in values.chunks_exact(self.group * outputs).enumerate() {
                                vectorized(|| maximum(group, best));
                                // SAFETY: no group is in two blocks.
                                out.write((block.start / self.group + k) * outputs, best);
                            }
                        }
                    });
                });
            });
        }
    }

    fn pools(&self, layer: usize) -> bool {
        self.group > 1 && layer + 2 == self.channels.len()
    }

    fn input<'a>(&self, x: &'a [f32], hidden: &'a [Vec<f32>], norms: &'a [Norm], layer: usize) -> Input<'a> {
        match layer {
            0 => Input::Given { x, channels: self.channels[0] },
            _ => Input::Hidden { y: &hidden[layer - 1], norm: &norms[layer - 1] },
        }
    }

    fn write_rows(&self, rows: &Rows, input: Input<'_>, out: &mut Vec<f32>) {
        let channels = input.channels();
        // SAFETY: the blocks cover all rows.
        unsafe {
            fill(out, self.out_len(), |out| {
                let out = Shared::new(out);
                rows.parts(|blocks| {
                    scratch::with([rows.block() * channels], |[memory]| {
                        for block in blocks {
                            // SAFETY: no row is in two blocks.
                            out.write(block.start * channels, input.rows(block, memory));
                        }
                    });
                });
            });
        }
    }

    fn check(&self, x: &[f32], layers: &[MlpLayer<'_>]) -> Rows {
        assert!(self.group > 0 && self.rows.is_multiple_of(self.group), "whole groups: {self:?}");
        assert!(!layers.is_empty() && layers.len() + 1 == self.channels.len(), "a layer for each width of {self:?}");
        assert!(self.channels.iter().all(|&c| c > 0), "channels: {self:?}");
        assert_eq!(x.len(), self.rows * self.channels[0], "elements of x of {self:?}");
        for (layer, widths) in layers.iter().zip(self.channels.windows(2)) {
            assert_eq!(layer.weight.len(), widths[0] * widths[1], "weights of {self:?}");
            assert_eq!((layer.gamma.len(), layer.beta.len()), (widths[1], widths[1]), "norm of {self:?}");
        }
        Rows { count: self.rows, group: self.group }
    }
}

#[inline(always)]
fn bias_relu(values: &mut [f32], bias: &[f32]) {
    for row in values.chunks_exact_mut(bias.len()) {
        for (value, bias) in row.iter_mut().zip(bias) {
            let z = *value + bias;
            *value = if z < 0.0 { 0.0 } else { z };
        }
    }
}

/// The maximum of each column; NaN, once there, stays.
#[inline(always)]
fn maximum(group: &[f32], best: &mut [f32]) {
    best.fill(f32::NEG_INFINITY);
    for row in group.chunks_exact(best.len()) {
        for (best, &value) in best.iter_mut().zip(row) {
            *best = if value > *best || value.is_nan() { value } else { *best };
        }
    }
}

#[cfg(test)]
mod tests;
