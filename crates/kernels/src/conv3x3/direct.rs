//! Direct convolution: one matrix product with the 3x3 neighbourhoods of all pixels (im2col in blocks).

use crate::blocks::{Segment, TileGrid};
use crate::images::{Images, ImagesOut};
use crate::registers::{load, store_row};
use crate::scheme::{PackedWeights, Scheme};
use crate::tile::Row;
use pulp::Simd;
use std::ops::Range;

/// A tile is one pixel of the output. No other code may write to `y`.
pub(super) struct Direct<'a, const STRIDE: usize> {
    pub batch: usize,
    pub x: Images<'a>,
    pub y: ImagesOut<'a>,
}

/// Weights in the order of [`read_neighbours`]; `kernel(output, input)` is the 3x3 kernel of one pair of channels.
pub(super) fn pack(inputs: usize, outputs: usize, kernel: impl Fn(usize, usize) -> [f32; 9] + Sync) -> PackedWeights {
    PackedWeights::new(outputs, inputs * 9, |output, insert| {
        for input in 0..inputs {
            for (tap, weight) in kernel(output, input).into_iter().enumerate() {
                insert(input * 9 + tap, weight);
            }
        }
    })
}

/// The neighbours of each pixel of a block in one channel: `panel[ky * 3 + kx]`.
#[inline(always)]
pub(super) fn read_neighbours<S: Simd, const STRIDE: usize>(
    simd: S,
    x: &Images<'_>,
    segments: &[Segment],
    channel: usize,
    panel: &mut [Row],
) {
    for s in segments {
        for ky in 0..3 {
            let row = x.shape.row(s.image, channel, (s.row * STRIDE + ky) as isize - 1);
            for group in (0..s.len).step_by(S::F32_LANES) {
                let first = ((s.column + group) * STRIDE) as isize - 1;
                let mut neighbours = [simd.splat_f32s(0.0); 3];
                if STRIDE == 2 {
                    let pixels: [S::f32s; 2] = x.every(simd, row, first);
                    let behind: [S::f32s; 2] = x.every(simd, row, first + 2);
                    neighbours = [pixels[0], pixels[1], behind[0]];
                } else if let Some(row) = row {
                    for (kx, values) in neighbours.iter_mut().enumerate() {
                        *values = load(simd, x.values, row, first + kx as isize);
                    }
                }
                for (kx, values) in neighbours.into_iter().enumerate() {
                    store_row(simd, &mut panel[ky * 3 + kx], s.at + group, values);
                }
            }
        }
    }
}

impl<const STRIDE: usize> Scheme for Direct<'_, STRIDE> {
    fn grid(&self) -> TileGrid {
        TileGrid { batch: self.batch, rows: self.y.shape.height, columns: self.y.shape.width }
    }

    fn inputs(&self) -> usize {
        self.x.shape.channels
    }

    fn outputs(&self) -> usize {
        self.y.shape.channels
    }

    fn panel_rows(&self) -> usize {
        9 * self.inputs()
    }

    fn products(&self) -> Vec<Range<usize>> {
        std::iter::once(0..self.panel_rows()).collect()
    }

    #[inline(always)]
    fn prefetch_input(&self, segments: &[Segment], channel: usize) {
        self.x.prefetch(segments, channel, STRIDE, (1, 3));
    }

    #[inline(always)]
    fn prefetch_output(&self, segments: &[Segment], channel: usize) {
        self.y.prefetch(segments, channel, 1);
    }

    #[inline(always)]
    fn read<S: Simd>(&self, simd: S, segments: &[Segment], channel: usize, panel: &mut [Row]) {
        read_neighbours::<S, STRIDE>(simd, &self.x, segments, channel, &mut panel[channel * 9..]);
    }

    #[inline(always)]
    fn write<'r, S: Simd>(&self, simd: S, segments: &[Segment], channel: usize, products: impl Fn(usize) -> &'r Row) {
        // SAFETY: no pixel is in two blocks, and one thread works on a block.
        unsafe { self.y.write_rows::<S, 1>(simd, segments, channel, products) };
    }
}
