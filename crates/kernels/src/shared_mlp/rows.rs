//! Rows cut into blocks that stay in the cache, and blocks into parts whose sums are added in order.

use super::norm::Norm;
use rayon::prelude::*;
use std::ops::Range;

/// Rows of a block, about.
const BLOCK: usize = 256;

/// Parts, whatever the number of threads.
const PARTS: usize = 16;

/// Rows in groups of equal size; a block has whole groups.
#[derive(Clone, Copy, Debug)]
pub(super) struct Rows {
    pub count: usize,
    pub group: usize,
}

impl Rows {
    /// Rows of a block; the last may have fewer.
    pub fn block(&self) -> usize {
        (self.group * (BLOCK / self.group).max(1)).min(self.count)
    }

    /// Does some work for the blocks of each part, on all threads; the results in the order of the parts.
    pub fn parts<R: Send>(&self, work: impl Fn(&mut dyn Iterator<Item = Range<usize>>) -> R + Sync) -> Vec<R> {
        let block = self.block().max(1);
        let blocks = self.count.div_ceil(block);
        let parts = blocks.min(PARTS);
        let of_part = |part: usize| {
            let blocks = blocks * part / parts..blocks * (part + 1) / parts;
            work(&mut blocks.map(|b| b * block..((b + 1) * block).min(self.count)))
        };
        (0..parts).into_par_iter().map(of_part).collect()
    }
}

/// What a layer reads.
#[derive(Clone, Copy, Debug)]
pub(super) enum Input<'a> {
    /// The rows of the net, `[rows, channels]`.
    Given { x: &'a [f32], channels: usize },
    /// The layer before: its rows before batch norm and ReLU.
    Hidden { y: &'a [f32], norm: &'a Norm },
}

impl Input<'_> {
    pub fn channels(&self) -> usize {
        match self {
            Input::Given { channels, .. } => *channels,
            Input::Hidden { norm, .. } => norm.mean.len(),
        }
    }

    /// Some rows behind batch norm and ReLU, in `memory` if they are not there already.
    pub fn rows<'m>(&'m self, rows: Range<usize>, memory: &'m mut [f32]) -> &'m [f32] {
        let values = rows.start * self.channels()..rows.end * self.channels();
        match self {
            Input::Given { x, .. } => &x[values],
            Input::Hidden { y, norm } => {
                let memory = &mut memory[..values.len()];
                norm.relu(&y[values], memory);
                memory
            }
        }
    }
}

/// The sum of the parts' values, in their order.
pub(super) fn sum(parts: impl IntoIterator<Item = Vec<f32>>, len: usize) -> Vec<f32> {
    let mut parts = parts.into_iter();
    let mut total = parts.next().unwrap_or_else(|| vec![0.0; len]);
    for part in parts {
        for (total, part) in total.iter_mut().zip(part) {
            *total += part;
        }
    }
    total
}
