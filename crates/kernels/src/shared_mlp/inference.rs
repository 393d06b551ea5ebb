//! Inference: all layers of one block of rows after another, with given statistics.

use super::blocks::Blocks;
use super::input::Before;
use super::norm::Norm;
use super::{MlpInput, MlpLayer, SharedMlp};
use crate::batch_norm::Statistics;
use crate::fold::{Folded, NormParameters};
use crate::matrix::{Matrix, Then, multiply};
use crate::output::{Shared, fill};
use crate::scratch;
use crate::simd::vectorized;
use std::mem::MaybeUninit;

/// Computes `[groups, outputs]`; the output is overwritten.
pub(super) fn forward(
    mlp: &SharedMlp,
    blocks: &Blocks<'_>,
    input: MlpInput<'_>,
    layers: &[MlpLayer<'_>],
    statistics: &[Statistics],
    out: &mut Vec<f32>,
) {
    let fold = |(layer, statistics): (&MlpLayer<'_>, &Statistics)| {
        let MlpLayer { weight, gamma, beta } = *layer;
        if weight.is_empty() {
            return Folded { weight: Vec::new(), bias: Vec::new() };
        }
        NormParameters { gamma, beta, statistics, epsilon: mlp.epsilon }.fold_into_conv(weight)
    };
    let folded: Vec<Folded> = layers.iter().zip(statistics).map(fold).collect();
    assert_eq!(folded.len(), layers.len(), "statistics of each layer of {mlp:?}");
    let first = Before::first(input, layers[0].weight);
    let first_norm = Norm::new(&statistics[0], layers[0].gamma, layers[0].beta, mlp.epsilon);
    let widest = blocks.most_rows * mlp.channels.iter().max().copied().unwrap_or(0);
    let outputs = mlp.channels[layers.len()];
    let work = |out: &mut [MaybeUninit<f32>]| {
        let out = Shared::new(out);
        blocks.parts(|part| {
            scratch::with([widest, widest, outputs], |[from, to, best]| {
                let (mut from, mut to) = (from, to);
                for block in part {
                    let rows = block.rows.len();
                    for (l, layer) in folded.iter().enumerate() {
                        let [inputs, outputs] = [mlp.channels[l], mlp.channels[l + 1]];
                        let result = &mut to[..rows * outputs];
                        let weight = Matrix::new(&layer.weight, inputs.max(1)).transposed();
                        match (l, input, first) {
                            (0, _, Some(before)) => first_norm.relu(before.rows(block, outputs, from), result),
                            (0, MlpInput::Rows(x), _) => {
                                let x = &x[block.rows.start * inputs..block.rows.end * inputs];
                                multiply(Matrix::new(x, inputs), weight, result, Then::Store);
                                vectorized(|| bias_relu(result, &layer.bias));
                            }
                            _ => {
                                multiply(Matrix::new(&from[..rows * inputs], inputs), weight, result, Then::Store);
                                vectorized(|| bias_relu(result, &layer.bias));
                            }
                        }
                        std::mem::swap(&mut from, &mut to);
                    }
                    for group in block.groups.clone() {
                        let rows = blocks.group(group);
                        let first = rows.start - block.rows.start;
                        vectorized(|| maximum(&from[first * outputs..][..rows.len() * outputs], best));
                        // SAFETY: no group is in two blocks.
                        unsafe { out.write(group * outputs, best) };
                    }
                }
            });
        });
    };
    // SAFETY: the blocks cover all groups.
    unsafe { fill(out, blocks.groups() * outputs, work) };
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

/// The maximum of each column. NaN propagates.
#[inline(always)]
fn maximum(group: &[f32], best: &mut [f32]) {
    best.fill(f32::NEG_INFINITY);
    for row in group.chunks_exact(best.len()) {
        for (best, &value) in best.iter_mut().zip(row) {
            *best = if value > *best || value.is_nan() { value } else { *best };
        }
    }
}
