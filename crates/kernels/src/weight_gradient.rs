//! Gradients with respect to weights: for each block of tiles the product of a panel of `x` with one of `dy`, summed
//! over all blocks.
//!
//! The division of the blocks into parts depends on their number alone, and the sums of the parts are added in order.
//! The result therefore does not depend on the number of threads.

use crate::blocks::{Segment, TileGrid};
use crate::images::Images;
use crate::output::{Shared, fill};
use crate::scheme::is_zero;
use crate::scratch;
use crate::tile::{PIXELS, Row, TileWork, dispatch_tiles, outer, tile_rows, zeros};
use pulp::Simd;
use rayon::prelude::*;
use std::ops::Range;

/// Smallest number of blocks in a part; with fewer, adding up the parts takes longer than the products.
const BLOCKS_A_PART: usize = 12;
const MOST_PARTS: usize = 16;

/// Outputs that are processed together.
const OUTPUTS_AT_ONCE: usize = 128;

/// Outputs whose weights are computed together.
const OUTPUTS_A_TASK: usize = 16;

/// Upper limit of positions times rows, and of the weights of a pair of channels.
const MOST: usize = 36;

/// The factors of the product for a block of tiles, and the computation of the weights from the sums.
///
/// The sums over tiles t are `x[p][input * ROWS + row][t] dy[p][t][output]`, `[POSITIONS, inputs * ROWS, outputs]`.
pub(crate) trait Panels: Sync {
    /// Transformed values of a tile of `dy`.
    const POSITIONS: usize;
    /// Whether the panel of `x` is the same for all positions.
    const X_SHARED: bool;
    /// Rows of the panel of `x` for an input.
    const ROWS: usize;
    /// Columns, and rows, of the pixels of `dy` in a tile.
    const TILE: usize;
    /// Weights of a pair of channels.
    const TAPS: usize;

    /// The tiles.
    fn grid(&self) -> TileGrid;

    /// Channels of `x`.
    fn inputs(&self) -> usize;

    /// `dy`; its channels are the outputs.
    fn dy(&self) -> Images<'_>;

    /// Index of the first weight of a pair of channels.
    fn weight_at(&self, input: usize, output: usize) -> usize;

    /// Prefetches what [`Panels::read_x`] will read of another block.
    fn prefetch_x(&self, segments: &[Segment], input: usize);

    /// Writes the rows of an input: row r of position p to `panel[p * stride + r]`.
    fn read_x<S: Simd>(&self, simd: S, segments: &[Segment], input: usize, panel: &mut [Row], stride: usize);

    /// From the pixels of `dy` of one tile, `[TILE * TILE, columns]`, the values of each position p, to `to[p *
    /// step..][..columns]`.
    #[inline(always)]
    fn transform_dy<S: Simd>(&self, _: S, pixels: &[f32], columns: usize, to: &mut [f32], step: usize) {
        for (p, pixels) in pixels.chunks_exact(columns).enumerate() {
            to[p * step..][..columns].copy_from_slice(pixels);
        }
    }

    /// The weights `[TAPS]` from the sums `[POSITIONS * ROWS]` of an input, one output a lane.
    #[inline(always)]
    fn finish<S: Simd>(&self, _: S, sums: &[S::f32s], taps: &mut [S::f32s]) {
        taps.copy_from_slice(sums);
    }
}

/// Sizes of the sums of a part: `[positions, rows, columns]`, rows and columns rounded up to whole tiles of the
/// innermost loop.
#[derive(Clone, Copy)]
struct Sums {
    positions: usize,
    rows: usize,
    columns: usize,
}

impl Sums {
    fn len(&self) -> usize {
        self.positions * self.rows * self.columns
    }
}

/// The gradient; [`Panels::weight_at`] gives the index of each pair of channels.
pub(crate) fn weight_gradient<P: Panels>(panels: &P) -> Vec<f32> {
    let (blocks, inputs, outputs) = (panels.grid().blocks(), panels.inputs(), panels.dy().shape.channels);
    let len = inputs * outputs * P::TAPS;
    if blocks == 0 || len == 0 {
        return vec![0.0; len];
    }
    let parts = 1 << (blocks / BLOCKS_A_PART).clamp(1, MOST_PARTS).ilog2();
    let columns = outputs.min(OUTPUTS_AT_ONCE).next_multiple_of(PIXELS);
    let splits = outputs.div_ceil(columns);
    let sums = Sums { positions: P::POSITIONS, rows: (inputs * P::ROWS).next_multiple_of(tile_rows()), columns };
    let mut dw = Vec::new();
    scratch::with([parts * splits * sums.len()], |[memory]| {
        memory.par_chunks_mut(sums.len()).enumerate().for_each(|(task, memory)| {
            let (part, first) = (task / splits, task % splits * columns);
            let blocks = blocks * part / parts..blocks * (part + 1) / parts;
            sum_part(panels, blocks, first..outputs.min(first + columns), sums, memory);
        });
        // SAFETY: the tasks cover all outputs, and each writes the weights of all inputs.
        unsafe {
            fill(&mut dw, len, |dw| {
                let dw = Shared::new(dw);
                (0..outputs.div_ceil(OUTPUTS_A_TASK)).into_par_iter().for_each(|task| {
                    let first = task * OUTPUTS_A_TASK;
                    let parts = memory.chunks_exact(sums.len()).skip(first / columns).step_by(splits);
                    let outputs = first..outputs.min(first + OUTPUTS_A_TASK);
                    dispatch_tiles(Finish { panels, parts, sums, outputs, dw });
                });
            });
        }
    });
    dw
}

fn sum_part<P: Panels>(panels: &P, blocks: Range<usize>, outputs: Range<usize>, sums: Sums, memory: &mut [f32]) {
    let x_positions = if P::X_SHARED { 1 } else { P::POSITIONS };
    let lengths = [
        x_positions * (sums.rows + 1) * PIXELS,
        P::POSITIONS * (PIXELS + 1) * sums.columns,
        PIXELS * P::TILE * P::TILE * sums.columns,
    ];
    scratch::with(lengths, |[x_panel, dy_panel, pixels]| {
        // The padding beyond the inputs and outputs stays zero.
        x_panel.fill(0.0);
        pixels.fill(0.0);
        let x_panel = x_panel.as_chunks_mut().0;
        dispatch_tiles(Part { panels, blocks, outputs, sums, memory, x_panel, dy_panel, pixels });
    });
}

/// The sums of one part of the blocks for a range of outputs.
struct Part<'a, P> {
    panels: &'a P,
    blocks: Range<usize>,
    outputs: Range<usize>,
    sums: Sums,
    memory: &'a mut [f32],
    x_panel: &'a mut [Row],
    dy_panel: &'a mut [f32],
    pixels: &'a mut [f32],
}

impl<P: Panels> TileWork for Part<'_, P> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd, const R: usize, const V: usize>(mut self, simd: S) {
        let Sums { rows, columns, .. } = self.sums;
        let dy_step = (PIXELS + 1) * columns;
        let x_step = if P::X_SHARED { 0 } else { rows + 1 };
        let mut begun = false;
        for block in self.blocks.clone() {
            let segments = self.panels.grid().segments(block);
            let tiles = segments.tiles();
            let next = self.panels.grid().segments(block + 1);
            for input in 0..self.panels.inputs() {
                self.panels.prefetch_x(next.list(), input);
                let panel = &mut self.x_panel[input * P::ROWS..];
                self.panels.read_x(simd, segments.list(), input, panel, rows + 1);
            }
            if is_zero(self.x_panel) {
                continue;
            }
            self.read_dy(simd, segments.list(), next.list());
            for (t, pixels) in self.pixels.chunks_exact(P::TILE * P::TILE * columns).take(tiles).enumerate() {
                self.panels.transform_dy(simd, pixels, columns, &mut self.dy_panel[t * columns..], dy_step);
            }
            for p in 0..P::POSITIONS {
                let left = self.x_panel[p * x_step..][..rows].as_chunks::<R>().0;
                let right = &self.dy_panel[p * dy_step..][..PIXELS * columns];
                let sums = &mut self.memory[p * rows * columns..][..rows * columns];
                for (left, sums) in left.iter().zip(sums.chunks_exact_mut(R * columns)) {
                    for at in (0..columns).step_by(V * S::F32_LANES) {
                        let place = |r: usize| r * columns + at..r * columns + at + V * S::F32_LANES;
                        let mut tile = zeros::<S, R, V>(simd);
                        if begun {
                            for r in 0..R {
                                tile[r] = S::as_simd_f32s(&sums[place(r)]).0.as_chunks::<V>().0[0];
                            }
                        }
                        let tile = outer(simd, tile, left, right, (columns, at), tiles);
                        for r in 0..R {
                            S::as_mut_simd_f32s(&mut sums[place(r)]).0.as_chunks_mut::<V>().0[0] = tile[r];
                        }
                    }
                }
            }
            begun = true;
        }
        if !begun {
            self.memory.fill(0.0);
        }
    }
}

impl<P: Panels> Part<'_, P> {
    /// The pixels of `dy` of each tile, outputs side by side: `[PIXELS, TILE * TILE, columns]`.
    #[inline(always)]
    fn read_dy<S: Simd>(&mut self, simd: S, segments: &[Segment], next: &[Segment]) {
        let (size, columns) = (P::TILE * P::TILE, self.sums.columns);
        let dy = self.panels.dy();
        let mut tiles = [[0.0; PIXELS]; 16];
        for output in self.outputs.clone() {
            dy.prefetch(next, output, P::TILE, (0, P::TILE));
            match P::TILE {
                1 => dy.read_tiles::<S, 1>(simd, segments, output, &mut tiles),
                2 => dy.read_tiles::<S, 2>(simd, segments, output, &mut tiles),
                _ => dy.read_tiles::<S, 4>(simd, segments, output, &mut tiles),
            }
            let to = &mut self.pixels[output - self.outputs.start..];
            for (pixel, tiles) in tiles[..size].iter().enumerate() {
                for (t, &value) in tiles.iter().enumerate() {
                    to[(t * size + pixel) * columns] = value;
                }
            }
        }
    }
}

/// Adds up the parts and computes the weights.
struct Finish<'a, P, I> {
    panels: &'a P,
    parts: I,
    sums: Sums,
    outputs: Range<usize>,
    dw: Shared<'a>,
}

impl<'a, P: Panels, I: Iterator<Item = &'a [f32]> + Clone> TileWork for Finish<'_, P, I> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd, const R: usize, const V: usize>(self, simd: S) {
        let Sums { rows, columns, .. } = self.sums;
        let zero = simd.splat_f32s(0.0);
        let (mut total, mut taps) = ([zero; MOST], [zero; MOST]);
        for input in 0..self.panels.inputs() {
            for first in self.outputs.clone().step_by(S::F32_LANES) {
                for p in 0..P::POSITIONS {
                    for r in 0..P::ROWS {
                        let at = (p * rows + input * P::ROWS + r) * columns + first % columns;
                        let mut sum = zero;
                        for part in self.parts.clone() {
                            sum = simd.add_f32s(sum, S::as_simd_f32s(&part[at..at + S::F32_LANES]).0[0]);
                        }
                        total[p * P::ROWS + r] = sum;
                    }
                }
                self.panels.finish(simd, &total[..P::POSITIONS * P::ROWS], &mut taps[..P::TAPS]);
                let mut values = [[0.0; 16]; MOST]; // [TAPS, lanes]
                for (values, &taps) in values.iter_mut().zip(&taps[..P::TAPS]) {
                    S::as_mut_simd_f32s(values).0[0] = taps;
                }
                for (lane, output) in (first..self.outputs.end.min(first + S::F32_LANES)).enumerate() {
                    let weights: [f32; MOST] = std::array::from_fn(|tap| values[tap][lane]);
                    // SAFETY: no pair of channels is in two tasks.
                    unsafe { self.dw.write(self.panels.weight_at(input, output), &weights[..P::TAPS]) };
                }
            }
        }
    }
}
