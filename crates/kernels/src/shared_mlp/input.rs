//! The input of a layer.

use super::MlpInput;
use super::blocks::Block;
use super::norm::Norm;
use crate::simd::vectorized;

/// Rows before a batch norm.
#[derive(Clone, Copy, Debug)]
pub(super) enum Before<'a> {
    /// Stored, `[rows, channels]`.
    Stored(&'a [f32]),
    /// Computed: each is the sum of a row of `features`, `[P, channels]`, and `weight`, `[channels, 3]`, times its
    /// offset.
    Gathered { features: &'a [f32], source: &'a [u32], offset: &'a [[f32; 3]], weight: &'a [f32] },
}

impl<'a> Before<'a> {
    /// The output rows of the first layer, if they need no matrix product; `weight` is that of the layer.
    pub fn first(input: MlpInput<'a>, weight: &'a [f32]) -> Option<Self> {
        match input {
            MlpInput::Rows(_) => None,
            MlpInput::Projected(y) => Some(Before::Stored(y)),
            MlpInput::Gathered { features, source, offset } => {
                Some(Before::Gathered { features, source, offset, weight })
            }
        }
    }

    /// The rows of a block; computed into `memory` if they are not stored.
    pub fn rows<'m>(&self, block: &Block, channels: usize, memory: &'m mut [f32]) -> &'m [f32]
    where
        'a: 'm,
    {
        match *self {
            Before::Stored(y) => &y[block.rows.start * channels..block.rows.end * channels],
            Before::Gathered { features, source, offset, weight } => {
                let memory = &mut memory[..block.rows.len() * channels];
                let columns: [Vec<f32>; 3] =
                    std::array::from_fn(|axis| weight.iter().skip(axis).step_by(3).copied().collect());
                let [wx, wy, wz] = columns.each_ref().map(|c| &c[..channels]);
                let sources = source[block.rows.clone()].iter().zip(&offset[block.rows.clone()]);
                vectorized(|| {
                    for (row, (&source, &[x, y, z])) in memory.chunks_exact_mut(channels).zip(sources) {
                        let features = &features[source as usize * channels..][..channels];
                        for c in 0..channels {
                            row[c] = features[c] + (x * wx[c] + y * wy[c] + z * wz[c]);
                        }
                    }
                });
                memory
            }
        }
    }
}

/// The input rows of a layer's matrix product.
#[derive(Clone, Copy, Debug)]
pub(super) enum Input<'a> {
    /// The input of the net, `[rows, channels]`.
    Given { x: &'a [f32], channels: usize },
    /// The previous layer.
    Hidden { before: Before<'a>, norm: &'a Norm },
}

impl Input<'_> {
    pub fn channels(&self) -> usize {
        match self {
            Input::Given { channels, .. } => *channels,
            Input::Hidden { norm, .. } => norm.channels(),
        }
    }

    /// The rows of a block, computed into `memory` if they are not stored. The second slice holds the rows of a hidden
    /// layer before its batch norm, computed into `before` if they are not stored.
    pub fn rows<'m>(&'m self, block: &Block, memory: &'m mut [f32], before: &'m mut [f32]) -> (&'m [f32], &'m [f32]) {
        match self {
            Input::Given { x, channels } => (&x[block.rows.start * channels..block.rows.end * channels], &[]),
            Input::Hidden { before: source, norm } => {
                let y = source.rows(block, norm.channels(), before);
                let memory = &mut memory[..y.len()];
                norm.relu(y, memory);
                (memory, y)
            }
        }
    }
}
