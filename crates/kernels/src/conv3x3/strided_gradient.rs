//! Gradient with respect to the input of a convolution of stride 2. A tile is 2 x 2 pixels of `dx`. Of the nine kernel
//! taps, one contributes to its first pixel, two each to the second and third, and four to the last.

use super::Conv3x3;
use crate::blocks::{Segment, TileGrid};
use crate::images::{Images, ImagesOut};
use crate::registers::store_row;
use crate::scheme::{PackedWeights, Scheme};
use crate::tile::Row;
use pulp::Simd;
use std::ops::Range;

/// The pixels of `dy` that a tile reads, as (row, column) offsets, ordered so that each product reads a contiguous
/// range.
pub(super) const SHIFTS: [(usize, usize); 4] = [(1, 0), (0, 0), (0, 1), (1, 1)];

/// For each pixel of a tile the range of [`SHIFTS`] and, for each of them, the tap `ky * 3 + kx`.
pub(super) const PRODUCTS: [(Range<usize>, &[usize]); 4] =
    [(1..2, &[4]), (1..3, &[5, 3]), (0..2, &[1, 7]), (0..4, &[2, 8, 6, 0])];

/// No other code may write to `dx`.
pub(super) struct StridedGradient<'a> {
    pub batch: usize,
    pub dy: Images<'a>,
    pub dx: ImagesOut<'a>,
}

/// The weights `[outputs, inputs, 3, 3]` of `conv` for [`StridedGradient`].
pub(super) fn pack(conv: &Conv3x3, weight: &[f32]) -> PackedWeights {
    pack_taps(conv, weight, &PRODUCTS.map(|(_, taps)| taps).concat())
}

/// The weights of some taps in their order.
pub(super) fn pack_taps(conv: &Conv3x3, weight: &[f32], taps: &[usize]) -> PackedWeights {
    PackedWeights::new(conv.inputs, taps.len() * conv.outputs, |input, insert| {
        for (k, tap) in taps.iter().enumerate() {
            for output in 0..conv.outputs {
                insert(k * conv.outputs + output, weight[(output * conv.inputs + input) * 9 + tap]);
            }
        }
    })
}

impl Scheme for StridedGradient<'_> {
    fn grid(&self) -> TileGrid {
        TileGrid { batch: self.batch, rows: self.dy.shape.height, columns: self.dy.shape.width }
    }

    fn inputs(&self) -> usize {
        self.dy.shape.channels
    }

    fn outputs(&self) -> usize {
        self.dx.shape.channels
    }

    fn panel_rows(&self) -> usize {
        SHIFTS.len() * self.inputs()
    }

    fn products(&self) -> Vec<Range<usize>> {
        PRODUCTS.iter().map(|(shifts, _)| shifts.start * self.inputs()..shifts.end * self.inputs()).collect()
    }

    #[inline(always)]
    fn prefetch_input(&self, segments: &[Segment], channel: usize) {
        self.dy.prefetch(segments, channel, 1, (0, 2));
    }

    #[inline(always)]
    fn prefetch_output(&self, segments: &[Segment], channel: usize) {
        self.dx.prefetch(segments, channel, 2);
    }

    #[inline(always)]
    fn read<S: Simd>(&self, simd: S, segments: &[Segment], channel: usize, panel: &mut [Row]) {
        for s in segments {
            for (k, (down, right)) in SHIFTS.into_iter().enumerate() {
                let row = self.dy.shape.row(s.image, channel, (s.row + down) as isize);
                for group in (0..s.len).step_by(S::F32_LANES) {
                    let [values] = self.dy.every(simd, row, (s.column + group + right) as isize);
                    store_row(simd, &mut panel[k * self.inputs() + channel], s.at + group, values);
                }
            }
        }
    }

    #[inline(always)]
    fn write<'r, S: Simd>(&self, simd: S, segments: &[Segment], channel: usize, products: impl Fn(usize) -> &'r Row) {
        // SAFETY: no tile is in two blocks, and one thread works on a block.
        unsafe { self.dx.write_rows::<S, 2>(simd, segments, channel, products) };
    }
}
