//! The last layer and the maximum over a group behind it. Its output is not kept: relu(norm(y)) rises or falls with y, by the sign of gamma, so
//! the largest or smallest y of a group is all that the output needs.
//!
//! Nor does the gradient need it. With g the gradient at the rows that the maximum took, `dy = g scale + (y - mean) slope + offset` and
//! y = a W^T,
//! `da = g scale W + a Q + q`, Q = W^T diag(slope) W, q = (offset - mean slope) W, and
//! `dW = (g scale)^T a + diag(slope) W C + offset sum(a)`, C the sum over rows of the products of a's deviations from its mean.
//! The products with g touch one row in a group for each channel.

use super::dense::{Upstream, pass_on};
use super::norm::{ColumnSums, Norm, NormGradient};
use super::rows::{Input, Rows, sum};
use crate::batch_norm::Statistics;
use crate::matrix::{Matrix, Then, multiply};
use crate::output::{Shared, fill};
use crate::scratch;
use crate::simd::vectorized;
use rayon::prelude::*;
use std::mem::MaybeUninit;

/// The row that each output of a group comes from.
#[derive(Clone, Debug)]
pub(super) struct Extremes {
    /// y there, `[groups, channels]`.
    pub y: Vec<f32>,
    /// Its place in the group, `[groups, channels]`.
    pub row: Vec<u32>,
}

/// The statistics of `y = input W^T`, and its extremes in each group.
pub(super) fn forward(rows: &Rows, input: Input<'_>, weight: &[f32], gamma: &[f32]) -> (Statistics, Extremes) {
    let outputs = gamma.len();
    let groups = rows.count / rows.group;
    let sign: Vec<f32> = gamma.iter().map(|&g| if g < 0.0 { -1.0 } else { 1.0 }).collect();
    let mut extremes = Extremes { y: Vec::new(), row: Vec::new() };
    let Extremes { y, row } = &mut extremes;
    let work = |y: &mut [MaybeUninit<f32>], row: &mut [MaybeUninit<u32>]| {
        let (y, row) = (Shared::new(y), Shared::new(row));
        rows.parts(|blocks| {
            let mut sums = ColumnSums::new(outputs);
            let mut its_row = vec![0; outputs];
            let lengths = [rows.block() * input.channels(), rows.block() * outputs, outputs];
            scratch::with(lengths, |[memory, product, best]| {
                for block in blocks {
                    let product = &mut product[..block.len() * outputs];
                    let first = block.start / rows.group;
                    let a = Matrix::new(input.rows(block, memory), input.channels());
                    multiply(a, Matrix::new(weight, input.channels()).transposed(), product, Then::Store);
                    sums.add_moments(product);
                    for (k, group) in product.chunks_exact(rows.group * outputs).enumerate() {
                        let at = (first + k) * outputs;
                        vectorized(|| largest(group, &sign, best, &mut its_row));
                        // SAFETY: no group is in two blocks.
                        unsafe {
                            y.write(at, best);
                            row.write(at, &its_row);
                        }
                    }
                }
            });
            sums
        })
    };
    // SAFETY: the blocks cover all groups.
    let parts = unsafe { fill(y, groups * outputs, |y| fill(row, groups * outputs, |row| work(y, row))) };
    (ColumnSums::total(outputs, parts.iter()).statistics(rows.count), extremes)
}

/// For each column of `group` the first value that is largest times its sign, and its row; NaN, once there, stays.
#[inline(always)]
fn largest(group: &[f32], sign: &[f32], best: &mut [f32], row: &mut [u32]) {
    let channels = sign.len();
    let (best, row) = (&mut best[..channels], &mut row[..channels]);
    best.fill(f32::NEG_INFINITY);
    row.fill(0);
    for (r, y) in group.chunks_exact(channels).enumerate() {
        for c in 0..channels {
            let key = y[c] * sign[c];
            let takes = key > best[c] || key.is_nan();
            best[c] = if takes { key } else { best[c] };
            row[c] = if takes { r as u32 } else { row[c] };
        }
    }
    for c in 0..channels {
        best[c] *= sign[c];
    }
}

/// `relu(norm(y))` of the extremes.
pub(super) fn output(extremes: &Extremes, norm: &Norm, out: &mut Vec<f32>) {
    out.clear();
    let channels = norm.mean.len();
    out.extend(extremes.y.iter().enumerate().map(|(i, &y)| {
        let z = norm.of(y, i % channels);
        if z < 0.0 { 0.0 } else { z }
    }));
}

/// The gradient before the ReLU, `[groups, channels]`, and its sums.
pub(super) fn last(extremes: &Extremes, norm: &Norm, dout: &[f32]) -> Upstream {
    let channels = norm.mean.len();
    let masked = |(i, (&y, &d)): (usize, (&f32, &f32))| if norm.of(y, i % channels) > 0.0 { d } else { 0.0 };
    let gradient: Vec<f32> = extremes.y.iter().zip(dout).enumerate().map(masked).collect();
    let mut sums = ColumnSums::new(channels);
    sums.add_gradients(&gradient, &extremes.y, norm);
    Upstream { gradient, sums }
}

/// The gradient by the weights, and what goes to the layer before; for the first layer the gradient by the rows instead, if it is wanted.
pub(super) fn backward(
    rows: &Rows,
    input: Input<'_>,
    (weight, statistics, norm): (&[f32], &Statistics, &Norm),
    (extremes, upstream): (&Extremes, &Upstream),
    gradient: &NormGradient,
    wanted: bool,
) -> (Vec<f32>, Upstream) {
    let (inputs, outputs) = (input.channels(), norm.mean.len());
    let scaled: Vec<f32> = upstream.gradient.iter().enumerate().map(|(i, &g)| g * norm.scale[i % outputs]).collect();
    let slope: Vec<f32> = gradient.slope.iter().map(|&s| s as f32).collect();
    let sloped: Vec<f32> = weight.iter().enumerate().map(|(i, &w)| w * slope[i / inputs]).collect(); // diag(slope) W
    let mut square = vec![0.0; inputs * inputs]; // Q
    multiply(Matrix::new(weight, inputs).transposed(), Matrix::new(&sloped, inputs), &mut square, Then::Store);
    let mut shift = vec![0.0f64; inputs]; // q
    for (c, row) in weight.chunks_exact(inputs).enumerate() {
        let factor = gradient.offset[c] - statistics.mean[c] * gradient.slope[c];
        for (shift, &w) in shift.iter_mut().zip(row) {
            *shift += factor * w as f64;
        }
    }
    let shift: Vec<f32> = shift.iter().map(|&v| v as f32).collect();
    let mut before = Vec::new();
    let work = |before: &mut [MaybeUninit<f32>]| {
        let before = Shared::new(before);
        rows.parts(|blocks| {
            let (mut products, mut dw) = (vec![0.0; inputs * inputs], vec![0.0; weight.len()]);
            let (mut moments, mut sums) = (ColumnSums::new(inputs), ColumnSums::new(inputs));
            scratch::with([rows.block() * inputs; 2], |[memory, da]| {
                for block in blocks {
                    let da = &mut da[..block.len() * inputs];
                    let groups = block.start / rows.group..block.end / rows.group;
                    let values = groups.start * outputs..groups.end * outputs;
                    let taken = Taken { scaled: &scaled[values.clone()], row: &extremes.row[values], outputs };
                    let a = input.rows(block.clone(), memory);
                    let matrix = Matrix::new(a, inputs);
                    multiply(matrix.transposed(), matrix, &mut products, Then::Add);
                    moments.add_moments(a);
                    if wanted {
                        multiply(matrix, Matrix::new(&square, inputs), da, Then::Store);
                        vectorized(|| taken.add_both(rows.group, weight, &shift, a, da, &mut dw));
                        pass_on(input, a, block.start, da, &mut sums);
                        // SAFETY: no row is in two blocks.
                        unsafe { before.write(block.start * inputs, da) };
                    } else {
                        vectorized(|| taken.add_weights(rows.group, inputs, a, &mut dw));
                    }
                }
            });
            (products, dw, moments, sums)
        })
    };
    // SAFETY: the blocks cover all rows.
    let parts = unsafe { fill(&mut before, if wanted { rows.count * inputs } else { 0 }, work) };
    let moments = ColumnSums::total(inputs, parts.iter().map(|p| &p.2));
    let sums = ColumnSums::total(inputs, parts.iter().map(|p| &p.3));
    // C: the products around the mean, in f64 until here.
    let n = rows.count.max(1) as f64;
    let centred: Vec<f32> = (0..inputs * inputs)
        .into_par_iter()
        .map(|i| {
            let total: f64 = parts.iter().map(|p| p.0[i] as f64).sum();
            (total - moments.first()[i / inputs] * moments.first()[i % inputs] / n) as f32
        })
        .collect();
    let mut dw = sum(parts.into_iter().map(|p| p.1), weight.len());
    multiply(Matrix::new(&sloped, inputs), Matrix::new(&centred, inputs), &mut dw, Then::Add);
    for (row, &offset) in dw.chunks_exact_mut(inputs).zip(&gradient.offset) {
        for (dw, &sum) in row.iter_mut().zip(moments.first()) {
            *dw += (offset * sum) as f32;
        }
    }
    (dw, Upstream { gradient: before, sums })
}

/// The rows of a block that the maximum took, one a group and channel, with the gradient there times scale.
struct Taken<'a> {
    scaled: &'a [f32],
    row: &'a [u32],
    outputs: usize,
}

impl Taken<'_> {
    /// Adds to `da`, `[rows, inputs]`, the shift and the gradients through `weight`, and to `dw` their products with `a`.
    #[inline(always)]
    fn add_both(&self, group: usize, weight: &[f32], shift: &[f32], a: &[f32], da: &mut [f32], dw: &mut [f32]) {
        let inputs = shift.len();
        for row in da.chunks_exact_mut(inputs) {
            for (da, shift) in row.iter_mut().zip(shift) {
                *da += shift;
            }
        }
        for (k, (&g, &row)) in self.scaled.iter().zip(self.row).enumerate() {
            if g == 0.0 {
                continue;
            }
            let (at, channel) = ((k / self.outputs * group + row as usize) * inputs, k % self.outputs * inputs);
            let weight = &weight[channel..channel + inputs];
            for (da, w) in da[at..at + inputs].iter_mut().zip(weight) {
                *da += g * w;
            }
            for (dw, a) in dw[channel..channel + inputs].iter_mut().zip(&a[at..at + inputs]) {
                *dw += g * a;
            }
        }
    }

    /// The part of [`Taken::add_both`] that the weights need.
    #[inline(always)]
    fn add_weights(&self, group: usize, inputs: usize, a: &[f32], dw: &mut [f32]) {
        for (k, (&g, &row)) in self.scaled.iter().zip(self.row).enumerate() {
            if g == 0.0 {
                continue;
            }
            let (at, channel) = ((k / self.outputs * group + row as usize) * inputs, k % self.outputs * inputs);
            for (dw, a) in dw[channel..channel + inputs].iter_mut().zip(&a[at..at + inputs]) {
                *dw += g * a;
            }
        }
    }
}
