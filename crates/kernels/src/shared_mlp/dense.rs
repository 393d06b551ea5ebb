//! A layer whose output is kept for all rows.

use super::norm::mask;
use super::norm::{ColumnSums, Norm, NormGradient};
use super::rows::{Input, Rows, sum};
use crate::batch_norm::Statistics;
use crate::matrix::{Matrix, Then, multiply};
use crate::output::{Shared, fill};
use crate::scratch;
use std::mem::MaybeUninit;

/// `y = input W^T`, `[rows, outputs]`, overwritten; returns its statistics.
pub(super) fn forward(rows: &Rows, input: Input<'_>, weight: &[f32], y: &mut Vec<f32>) -> Statistics {
    let outputs = weight.len() / input.channels();
    // SAFETY: the blocks cover all rows.
    let parts = unsafe {
        fill(y, rows.count * outputs, |y| {
            let y = Shared::new(y);
            rows.parts(|blocks| {
                let mut sums = ColumnSums::new(outputs);
                scratch::with([rows.block() * input.channels(), rows.block() * outputs], |[memory, product]| {
                    for block in blocks {
                        let (start, product) = (block.start * outputs, &mut product[..block.len() * outputs]);
                        let a = Matrix::new(input.rows(block, memory), input.channels());
                        multiply(a, Matrix::new(weight, input.channels()).transposed(), product, Then::Store);
                        sums.add_moments(product);
                        // SAFETY: no row is in two blocks.
                        y.write(start, product);
                    }
                });
                sums
            })
        })
    };
    ColumnSums::total(outputs, parts.iter()).statistics(rows.count)
}

/// What a layer hands to the one before it: the gradient behind that one's batch norm, `[rows, channels]`, and its sums.
pub(super) struct Upstream {
    pub gradient: Vec<f32>,
    pub sums: ColumnSums,
}

/// Masks the gradient by the output of the last layer: `relu(norm(y))`.
pub(super) fn last(rows: &Rows, y: &[f32], norm: &Norm, dout: &[f32]) -> Upstream {
    let channels = norm.mean.len();
    let mut gradient = Vec::new();
    // SAFETY: the blocks cover all rows.
    let parts = unsafe {
        fill(&mut gradient, y.len(), |gradient| {
            let gradient = Shared::new(gradient);
            rows.parts(|blocks| {
                let mut sums = ColumnSums::new(channels);
                scratch::with([rows.block() * channels; 2], |[activation, masked]| {
                    for block in blocks {
                        let values = block.start * channels..block.end * channels;
                        let (activation, masked) = (&mut activation[..values.len()], &mut masked[..values.len()]);
                        norm.relu(&y[values.clone()], activation);
                        masked.copy_from_slice(&dout[values.clone()]);
                        mask(masked, activation);
                        sums.add_gradients(masked, &y[values.clone()], norm);
                        // SAFETY: no row is in two blocks.
                        gradient.write(values.start, masked);
                    }
                });
                sums
            })
        })
    };
    Upstream { gradient, sums: ColumnSums::total(channels, parts.iter()) }
}

/// What a layer was in the forward pass.
#[derive(Clone, Copy)]
pub(super) struct Layer<'a> {
    /// `[outputs, inputs]`.
    pub weight: &'a [f32],
    pub y: &'a [f32],
    pub norm: &'a Norm,
}

/// The gradient by the weights, and what goes to the layer before; for the first layer the gradient by the rows instead, if it is wanted.
pub(super) fn backward(
    rows: &Rows,
    input: Input<'_>,
    layer: Layer<'_>,
    upstream: &Upstream,
    gradient: &NormGradient,
    wanted: bool,
) -> (Vec<f32>, Upstream) {
    let (inputs, outputs) = (input.channels(), layer.norm.mean.len());
    let mut before = Vec::new();
    let lengths = [rows.block() * inputs, rows.block() * outputs, rows.block() * inputs];
    let work = |before: &mut [MaybeUninit<f32>]| {
        let before = Shared::new(before);
        rows.parts(|blocks| {
            let mut dw = vec![0.0; layer.weight.len()];
            let mut sums = ColumnSums::new(inputs);
            scratch::with(lengths, |[memory, dy, da]| {
                for block in blocks {
                    let values = block.start * outputs..block.end * outputs;
                    let dy = &mut dy[..values.len()];
                    gradient.apply(&upstream.gradient[values.clone()], &layer.y[values], layer.norm, dy);
                    let dy = Matrix::new(dy, outputs);
                    let a = input.rows(block.clone(), memory);
                    multiply(dy.transposed(), Matrix::new(a, inputs), &mut dw, Then::Add);
                    if !wanted {
                        continue;
                    }
                    let da = &mut da[..block.len() * inputs];
                    multiply(dy, Matrix::new(layer.weight, inputs), da, Then::Store);
                    pass_on(input, a, block.start, da, &mut sums);
                    // SAFETY: no row is in two blocks.
                    unsafe { before.write(block.start * inputs, da) };
                }
            });
            (dw, sums)
        })
    };
    // SAFETY: the blocks cover all rows.
    let parts = unsafe { fill(&mut before, if wanted { rows.count * inputs } else { 0 }, work) };
    let (weights, sums): (Vec<_>, Vec<_>) = parts.into_iter().unzip();
    let sums = ColumnSums::total(inputs, sums.iter());
    (sum(weights, layer.weight.len()), Upstream { gradient: before, sums })
}

/// Masks the gradient by the activations `a` of some rows and takes its sums, unless they are the rows of the net itself.
pub(super) fn pass_on(input: Input<'_>, a: &[f32], first_row: usize, da: &mut [f32], sums: &mut ColumnSums) {
    if let Input::Hidden { y, norm } = input {
        mask(da, a);
        sums.add_gradients(da, &y[first_row * input.channels()..][..da.len()], norm);
    }
}
