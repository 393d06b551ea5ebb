//! The last layer and the maximum over the groups. The layer's output y is not stored: relu(norm(y)) is monotone in y,
//! rising or falling with the sign of gamma, so the maximum over a group needs only its largest or smallest y.
//!
//! The gradient does not need y either. With g the gradient at the rows selected by the maximum, and n the multiplicity
//! of a row, `dy = g scale + n ((y - mean) slope + offset)` and y = a W^T, `da = g scale W + n (a Q + q)`, Q = W^T
//! diag(slope) W, q = (offset - mean slope) W, and `dW = (g scale)^T a + diag(slope) W C + offset sum(n a)`, C the sum
//! over rows of n times the products of a's deviations from its mean. The products with g touch one row in a group for
//! each channel.

use super::blocks::{Blocks, sum};
use super::dense::{Upstream, mask_and_sum};
use super::input::Input;
use super::norm::{ColumnSums, Norm, NormGradient};
use crate::batch_norm::Statistics;
use crate::matrix::{Matrix, Then, multiply};
use crate::output::{Shared, fill};
use crate::scratch;
use crate::simd::vectorized;
use rayon::prelude::*;
use std::mem::MaybeUninit;

/// The extreme value of each group and channel, and its row.
#[derive(Clone, Debug)]
pub(super) struct Extremes {
    /// The extreme y, `[groups, channels]`.
    pub y: Vec<f32>,
    /// Its row, `[groups, channels]`.
    pub row: Vec<u32>,
}

/// The statistics of `y = input W^T`, and its extremes in each group.
pub(super) fn forward(blocks: &Blocks<'_>, input: Input<'_>, weight: &[f32], gamma: &[f32]) -> (Statistics, Extremes) {
    let (inputs, outputs) = (input.channels(), gamma.len());
    let sign: Vec<f32> = gamma.iter().map(|&g| if g < 0.0 { -1.0 } else { 1.0 }).collect();
    let lengths = [blocks.most_rows * inputs, blocks.most_rows * inputs, blocks.most_rows * outputs, outputs];
    let work = |y: &mut [MaybeUninit<f32>], row: &mut [MaybeUninit<u32>]| {
        let (y, row) = (Shared::new(y), Shared::new(row));
        blocks.parts(|part| {
            let mut sums = ColumnSums::new(outputs);
            let mut best_row = vec![0; outputs];
            scratch::with(lengths, |[memory, before, product, best]| {
                for block in part {
                    let product = &mut product[..block.rows.len() * outputs];
                    let a = Matrix::new(input.rows(block, memory, before).0, inputs);
                    multiply(a, Matrix::new(weight, inputs).transposed(), product, Then::Store);
                    sums.add_moments(product, blocks.counts(block));
                    for group in block.groups.clone() {
                        let rows = blocks.group(group);
                        let first = rows.start - block.rows.start;
                        let values = &product[first * outputs..][..rows.len() * outputs];
                        vectorized(|| largest(values, &sign, rows.start as u32, best, &mut best_row));
                        // SAFETY: no group is in two blocks.
                        unsafe {
                            y.write(group * outputs, best);
                            row.write(group * outputs, &best_row);
                        }
                    }
                }
            });
            sums
        })
    };
    let mut extremes = Extremes { y: Vec::new(), row: Vec::new() };
    let Extremes { y, row } = &mut extremes;
    let len = blocks.groups() * outputs;
    // SAFETY: the blocks cover all groups.
    let parts = unsafe { fill(y, len, |y| fill(row, len, |row| work(y, row))) };
    (ColumnSums::total(outputs, parts.iter()).statistics(blocks.total), extremes)
}

/// For each column of a group the first value whose product with its sign is largest, and its row. NaN propagates.
#[inline(always)]
fn largest(group: &[f32], sign: &[f32], first_row: u32, best: &mut [f32], row: &mut [u32]) {
    let channels = sign.len();
    let (best, row) = (&mut best[..channels], &mut row[..channels]);
    best.fill(f32::NEG_INFINITY);
    row.fill(first_row);
    for (r, y) in group.chunks_exact(channels).enumerate() {
        for c in 0..channels {
            let key = y[c] * sign[c];
            let takes = key > best[c] || key.is_nan();
            best[c] = if takes { key } else { best[c] };
            row[c] = if takes { first_row + r as u32 } else { row[c] };
        }
    }
    for c in 0..channels {
        best[c] *= sign[c];
    }
}

/// `relu(norm(y))` of the extremes.
pub(super) fn output(extremes: &Extremes, norm: &Norm, out: &mut Vec<f32>) {
    out.clear();
    out.extend(extremes.y.iter().enumerate().map(|(i, &y)| {
        let z = norm.of(y, i % norm.channels());
        if z < 0.0 { 0.0 } else { z }
    }));
}

/// The gradient before the ReLU, `[groups, channels]`, and its sums.
pub(super) fn last(extremes: &Extremes, norm: &Norm, dout: &[f32]) -> Upstream {
    let channels = norm.channels();
    let masked = |(i, (&y, &d)): (usize, (&f32, &f32))| if norm.of(y, i % channels) > 0.0 { d } else { 0.0 };
    let gradient: Vec<f32> = extremes.y.iter().zip(dout).enumerate().map(masked).collect();
    let mut sums = ColumnSums::new(channels);
    sums.add_gradients(&gradient, &extremes.y, norm);
    Upstream { gradient, sums }
}

/// The last layer in the backward pass.
#[derive(Clone, Copy)]
pub(super) struct Pooled<'a> {
    /// `[outputs, inputs]`.
    pub weight: &'a [f32],
    pub statistics: &'a Statistics,
    pub norm: &'a Norm,
    pub gradient: &'a NormGradient,
    pub extremes: &'a Extremes,
}

/// The gradient with respect to the weights, and the upstream gradient of the previous layer; for the first layer the
/// gradient with respect to the input instead, if requested.
pub(super) fn backward(
    blocks: &Blocks<'_>,
    input: Input<'_>,
    layer: Pooled<'_>,
    upstream: &Upstream,
    wanted: bool,
) -> (Vec<f32>, Upstream) {
    let Pooled { weight, norm, gradient, extremes, .. } = layer;
    let (inputs, outputs) = (input.channels(), norm.channels());
    let scaled: Vec<f32> = upstream.gradient.iter().enumerate().map(|(i, &g)| g * norm.scale[i % outputs]).collect();
    // diag(slope) W
    let sloped: Vec<f32> = weight.iter().enumerate().map(|(i, &w)| w * gradient.slope[i / inputs] as f32).collect();
    let mut square = vec![0.0; inputs * inputs]; // Q
    multiply(Matrix::new(weight, inputs).transposed(), Matrix::new(&sloped, inputs), &mut square, Then::Store);
    let shift = layer.shift();
    let most = blocks.most_rows * inputs;
    let mut before = Vec::new();
    let work = |before: &mut [MaybeUninit<f32>]| {
        let before = Shared::new(before);
        blocks.parts(|part| {
            let (mut products, mut dw) = (vec![0.0; inputs * inputs], vec![0.0; weight.len()]);
            let (mut moments, mut sums) = (ColumnSums::new(inputs), ColumnSums::new(inputs));
            scratch::with([most; 4], |[memory, input_before, counted, da]| {
                for block in part {
                    let (a, y) = input.rows(block, memory, input_before);
                    let (counted, da) = (&mut counted[..a.len()], &mut da[..a.len()]);
                    let counts = blocks.counts(block);
                    vectorized(|| times_counts(a, counts, counted));
                    multiply(
                        Matrix::new(counted, inputs).transposed(),
                        Matrix::new(a, inputs),
                        &mut products,
                        Then::Add,
                    );
                    moments.add_moments(a, counts);
                    let taken = Selected {
                        scaled: &scaled[block.groups.start * outputs..block.groups.end * outputs],
                        row: &extremes.row[block.groups.start * outputs..block.groups.end * outputs],
                        first_row: block.rows.start,
                        inputs,
                        outputs,
                    };
                    vectorized(|| taken.add_to_weights(a, &mut dw));
                    if wanted {
                        multiply(Matrix::new(counted, inputs), Matrix::new(&square, inputs), da, Then::Store);
                        vectorized(|| taken.add_to_rows(weight, &shift, counts, da));
                        mask_and_sum(input, a, y, da, &mut sums);
                        // SAFETY: no row is in two blocks.
                        unsafe { before.write(block.rows.start * inputs, da) };
                    }
                }
            });
            (products, dw, moments, sums)
        })
    };
    // SAFETY: the blocks cover all rows.
    let parts = unsafe { fill(&mut before, if wanted { blocks.rows * inputs } else { 0 }, work) };
    let moments = ColumnSums::total(inputs, parts.iter().map(|p| &p.2));
    let sums = ColumnSums::total(inputs, parts.iter().map(|p| &p.3));
    let sum_of_a = moments.first();
    // C; f64 up to here.
    let centred = |i: usize| {
        let products: f64 = parts.iter().map(|p| p.0[i] as f64).sum();
        (products - sum_of_a[i / inputs] * sum_of_a[i % inputs] / blocks.total) as f32
    };
    let centred: Vec<f32> = (0..inputs * inputs).into_par_iter().map(centred).collect();
    let mut dw = sum(parts.into_iter().map(|p| p.1), weight.len());
    multiply(Matrix::new(&sloped, inputs), Matrix::new(&centred, inputs), &mut dw, Then::Add);
    for (row, offset) in dw.chunks_exact_mut(inputs).zip(&gradient.offset) {
        for (dw, sum) in row.iter_mut().zip(sum_of_a) {
            *dw += (offset * sum) as f32;
        }
    }
    (dw, Upstream { gradient: before, sums })
}

impl Pooled<'_> {
    /// q.
    fn shift(&self) -> Vec<f32> {
        let inputs = self.weight.len() / self.norm.channels();
        let mut shift = vec![0.0f64; inputs];
        for (c, row) in self.weight.chunks_exact(inputs).enumerate() {
            let factor = self.gradient.offset[c] - self.statistics.mean[c] * self.gradient.slope[c];
            for (shift, &w) in shift.iter_mut().zip(row) {
                *shift += factor * w as f64;
            }
        }
        shift.iter().map(|&v| v as f32).collect()
    }
}

#[inline(always)]
fn times_counts(a: &[f32], counts: &[f32], out: &mut [f32]) {
    let inputs = a.len() / counts.len().max(1);
    for ((a, n), out) in a.chunks_exact(inputs).zip(counts).zip(out.chunks_exact_mut(inputs)) {
        for (a, out) in a.iter().zip(out) {
            *out = n * a;
        }
    }
}

/// The rows of a block selected by the maximum, one a group and channel, with the gradient times scale.
struct Selected<'a> {
    scaled: &'a [f32],
    row: &'a [u32],
    first_row: usize,
    inputs: usize,
    outputs: usize,
}

impl Selected<'_> {
    /// Calls `work` with gradient, index of the row in the block, and offset of the channel's weights for each nonzero
    /// gradient.
    #[inline(always)]
    fn each(&self, mut work: impl FnMut(f32, usize, usize)) {
        for (k, (&g, &row)) in self.scaled.iter().zip(self.row).enumerate() {
            if g != 0.0 {
                work(g, (row as usize - self.first_row) * self.inputs, k % self.outputs * self.inputs);
            }
        }
    }

    /// Adds (g scale)^T a.
    #[inline(always)]
    fn add_to_weights(&self, a: &[f32], dw: &mut [f32]) {
        self.each(|g, row, channel| {
            for (dw, a) in dw[channel..channel + self.inputs].iter_mut().zip(&a[row..row + self.inputs]) {
                *dw += g * a;
            }
        });
    }

    /// Adds n q + g scale W.
    #[inline(always)]
    fn add_to_rows(&self, weight: &[f32], shift: &[f32], counts: &[f32], da: &mut [f32]) {
        for (row, n) in da.chunks_exact_mut(self.inputs).zip(counts) {
            for (da, shift) in row.iter_mut().zip(shift) {
                *da += n * shift;
            }
        }
        self.each(|g, row, channel| {
            for (da, w) in da[row..row + self.inputs].iter_mut().zip(&weight[channel..channel + self.inputs]) {
                *da += g * w;
            }
        });
    }
}
