//! A layer whose output is stored for all rows.

use super::blocks::{Block, Blocks, sum};
use super::input::{Before, Input};
use super::norm::{ColumnSums, Norm, NormGradient, mask};
use crate::batch_norm::Statistics;
use crate::matrix::{Matrix, Then, multiply};
use crate::output::{Shared, fill};
use crate::scratch;
use std::mem::MaybeUninit;

/// Computes `y = input W^T`, `[rows, outputs]`, which is overwritten, and returns its statistics.
pub(super) fn forward(blocks: &Blocks<'_>, input: Input<'_>, weight: &[f32], y: &mut Vec<f32>) -> Statistics {
    let inputs = input.channels();
    let outputs = weight.len() / inputs;
    let lengths = [blocks.most_rows * inputs, blocks.most_rows * inputs, blocks.most_rows * outputs];
    let work = |y: &mut [MaybeUninit<f32>]| {
        let y = Shared::new(y);
        blocks.parts(|part| {
            let mut sums = ColumnSums::new(outputs);
            scratch::with(lengths, |[memory, before, product]| {
                for block in part {
                    let product = &mut product[..block.rows.len() * outputs];
                    let a = Matrix::new(input.rows(block, memory, before).0, inputs);
                    multiply(a, Matrix::new(weight, inputs).transposed(), product, Then::Store);
                    sums.add_moments(product, blocks.counts(block));
                    // SAFETY: no row is in two blocks.
                    unsafe { y.write(block.rows.start * outputs, product) };
                }
            });
            sums
        })
    };
    // SAFETY: the blocks cover all rows.
    let parts = unsafe { fill(y, blocks.rows * outputs, work) };
    ColumnSums::total(outputs, parts.iter()).statistics(blocks.total)
}

/// The statistics of rows that need no matrix product.
pub(super) fn statistics(blocks: &Blocks<'_>, before: Before<'_>, channels: usize) -> Statistics {
    let parts = blocks.parts(|part| {
        let mut sums = ColumnSums::new(channels);
        scratch::with([blocks.most_rows * channels], |[memory]| {
            for block in part {
                sums.add_moments(before.rows(block, channels, memory), blocks.counts(block));
            }
        });
        sums
    });
    ColumnSums::total(channels, parts.iter()).statistics(blocks.total)
}

/// The upstream gradient of a layer: with respect to the output of its batch norm, `[rows, channels]`, and its sums.
pub(super) struct Upstream {
    pub gradient: Vec<f32>,
    pub sums: ColumnSums,
}

/// Masks the output gradient `dout` with the ReLU of the last layer, `relu(norm(before))`, and computes its sums.
pub(super) fn last(blocks: &Blocks<'_>, before: Before<'_>, norm: &Norm, dout: &[f32]) -> Upstream {
    let channels = norm.channels();
    let mut gradient = Vec::new();
    let work = |gradient: &mut [MaybeUninit<f32>]| {
        let gradient = Shared::new(gradient);
        blocks.parts(|part| {
            let mut sums = ColumnSums::new(channels);
            scratch::with([blocks.most_rows * channels; 3], |[memory, activation, masked]| {
                for block in part {
                    let y = before.rows(block, channels, memory);
                    let (activation, masked) = (&mut activation[..y.len()], &mut masked[..y.len()]);
                    norm.relu(y, activation);
                    masked.copy_from_slice(&dout[block.rows.start * channels..][..y.len()]);
                    mask(masked, activation);
                    sums.add_gradients(masked, y, norm);
                    // SAFETY: no row is in two blocks.
                    unsafe { gradient.write(block.rows.start * channels, masked) };
                }
            });
            sums
        })
    };
    // SAFETY: the blocks cover all rows.
    let parts = unsafe { fill(&mut gradient, blocks.rows * channels, work) };
    Upstream { gradient, sums: ColumnSums::total(channels, parts.iter()) }
}

/// A layer in the backward pass.
#[derive(Clone, Copy)]
pub(super) struct Layer<'a> {
    /// `[outputs, inputs]`.
    pub weight: &'a [f32],
    /// The output before the batch norm.
    pub before: Before<'a>,
    pub norm: &'a Norm,
    pub gradient: &'a NormGradient,
}

impl Layer<'_> {
    /// The gradient with respect to the output before the batch norm of the rows of a block.
    fn dy<'m>(
        &self,
        blocks: &Blocks<'_>,
        block: &Block,
        upstream: &Upstream,
        memory: &mut [f32],
        dy: &'m mut [f32],
    ) -> &'m [f32] {
        let channels = self.norm.channels();
        let y = self.before.rows(block, channels, memory);
        let dy = &mut dy[..y.len()];
        let g = &upstream.gradient[block.rows.start * channels..][..y.len()];
        self.gradient.apply(g, y, blocks.counts(block), self.norm, dy);
        dy
    }
}

/// The gradient with respect to the weights, and the upstream gradient of the previous layer; for the first layer the
/// gradient with respect to the input instead, if requested.
pub(super) fn backward(
    blocks: &Blocks<'_>,
    input: Input<'_>,
    layer: Layer<'_>,
    upstream: &Upstream,
    wanted: bool,
) -> (Vec<f32>, Upstream) {
    let (inputs, outputs) = (input.channels(), layer.norm.channels());
    let most = blocks.most_rows;
    let lengths = [most * inputs, most * inputs, most * outputs, most * outputs, most * inputs];
    let mut before = Vec::new();
    let work = |before: &mut [MaybeUninit<f32>]| {
        let before = Shared::new(before);
        blocks.parts(|part| {
            let mut dw = vec![0.0; layer.weight.len()];
            let mut sums = ColumnSums::new(inputs);
            scratch::with(lengths, |[memory, input_before, own_before, dy, da]| {
                for block in part {
                    let dy = Matrix::new(layer.dy(blocks, block, upstream, own_before, dy), outputs);
                    let (a, y) = input.rows(block, memory, input_before);
                    multiply(dy.transposed(), Matrix::new(a, inputs), &mut dw, Then::Add);
                    if wanted {
                        let da = &mut da[..block.rows.len() * inputs];
                        multiply(dy, Matrix::new(layer.weight, inputs), da, Then::Store);
                        mask_and_sum(input, a, y, da, &mut sums);
                        // SAFETY: no row is in two blocks.
                        unsafe { before.write(block.rows.start * inputs, da) };
                    }
                }
            });
            (dw, sums)
        })
    };
    // SAFETY: the blocks cover all rows.
    let parts = unsafe { fill(&mut before, if wanted { blocks.rows * inputs } else { 0 }, work) };
    let (weights, sums): (Vec<_>, Vec<_>) = parts.into_iter().unzip();
    let sums = ColumnSums::total(inputs, sums.iter());
    (sum(weights, layer.weight.len()), Upstream { gradient: before, sums })
}

/// Masks the gradient `da` of some rows with the ReLU of their activations `a`, and adds it to the sums. `y`: the rows
/// before their batch norm. Does nothing for the input rows of the net.
pub(super) fn mask_and_sum(input: Input<'_>, a: &[f32], y: &[f32], da: &mut [f32], sums: &mut ColumnSums) {
    if let Input::Hidden { norm, .. } = input {
        mask(da, a);
        sums.add_gradients(da, y, norm);
    }
}

/// For a layer without a matrix product: the gradient with respect to its rows, `[rows, channels]`, and, with offsets,
/// the sum over the rows of gradient times offset, `[channels, 3]`.
pub(super) fn backward_first(
    blocks: &Blocks<'_>,
    layer: Layer<'_>,
    offset: Option<&[[f32; 3]]>,
    upstream: &Upstream,
) -> (Vec<f32>, Vec<f32>) {
    let channels = layer.norm.channels();
    let weights = if offset.is_some() { channels * 3 } else { 0 };
    let mut gradient = Vec::new();
    let work = |gradient: &mut [MaybeUninit<f32>]| {
        let gradient = Shared::new(gradient);
        blocks.parts(|part| {
            let mut dw = vec![0.0; weights];
            scratch::with([blocks.most_rows * channels; 2], |[memory, dy]| {
                for block in part {
                    let dy = layer.dy(blocks, block, upstream, memory, dy);
                    if let Some(offset) = offset {
                        let offset = Matrix::new(offset[block.rows.clone()].as_flattened(), 3);
                        multiply(Matrix::new(dy, channels).transposed(), offset, &mut dw, Then::Add);
                    }
                    // SAFETY: no row is in two blocks.
                    unsafe { gradient.write(block.rows.start * channels, dy) };
                }
            });
            dw
        })
    };
    // SAFETY: the blocks cover all rows.
    let parts = unsafe { fill(&mut gradient, blocks.rows * channels, work) };
    (gradient, sum(parts, weights))
}
