//! Gradient by the data of a convolution of stride 2. A tile is 2 x 2 pixels of `dx`; of the nine taps, one reaches its first pixel, two each
//! of its neighbours and four the last.

use super::Conv3x3;
use crate::blocks::{Segment, TileGrid};
use crate::images::{ImageShape, Work, rounded, write_tiles};
use crate::line;
use crate::output::Shared;
use crate::scheme::{PackedWeights, Scheme};
use crate::tile::{PIXELS, Row};
use pulp::Simd;
use std::ops::Range;

/// The pixels of `dy` that a tile reads, as (down, right) from its own place, in an order in which each product takes neighbours.
const SHIFTS: [(usize, usize); 4] = [(1, 0), (0, 0), (0, 1), (1, 1)];

/// For each pixel of a tile the range of [`SHIFTS`] and, for each of them, the tap `ky * 3 + kx`.
const PRODUCTS: [(Range<usize>, &[usize]); 4] = [(1..2, &[4]), (1..3, &[5, 3]), (0..2, &[1, 7]), (0..4, &[2, 8, 6, 0])];

pub(super) struct StridedGradient<'a> {
    batch: usize,
    dy: &'a [f32],
    dy_shape: ImageShape,
    dx: Shared<'a>,
    dx_shape: ImageShape,
}

impl<'a> StridedGradient<'a> {
    /// `dx` is written to; nothing else may be writing there.
    pub fn new(conv: &Conv3x3, dy: &'a [f32], dx: Shared<'a>) -> Self {
        let dy_shape = ImageShape { channels: conv.outputs, height: conv.out_height(), width: conv.out_width() };
        let dx_shape = ImageShape { channels: conv.inputs, height: conv.height, width: conv.width };
        StridedGradient { batch: conv.batch, dy, dy_shape, dx, dx_shape }
    }
}

/// The weights `[outputs, inputs, 3, 3]` of `conv` for [`StridedGradient`].
pub(super) fn pack(conv: &Conv3x3, weight: &[f32]) -> PackedWeights {
    PackedWeights::new(conv.inputs, 9 * conv.outputs, |input, put| {
        let taps = PRODUCTS.iter().flat_map(|(_, taps)| taps.iter());
        for (k, tap) in taps.enumerate() {
            for output in 0..conv.outputs {
                put(k * conv.outputs + output, weight[(output * conv.inputs + input) * 9 + tap]);
            }
        }
    })
}

impl Scheme for StridedGradient<'_> {
    fn grid(&self) -> TileGrid {
        TileGrid { batch: self.batch, rows: self.dy_shape.height, columns: self.dy_shape.width }
    }

    fn inputs(&self) -> usize {
        self.dy_shape.channels
    }

    fn outputs(&self) -> usize {
        self.dx_shape.channels
    }

    fn panel_rows(&self) -> usize {
        SHIFTS.len() * self.inputs()
    }

    fn products(&self) -> Vec<Range<usize>> {
        PRODUCTS.iter().map(|(shifts, _)| shifts.start * self.inputs()..shifts.end * self.inputs()).collect()
    }

    #[inline(always)]
    fn read<S: Simd>(&self, _: S, segments: &[Segment], channel: usize, panel: &mut [Row], work: &mut Work) {
        for s in segments {
            let count = rounded(s);
            for down in 0..2 {
                let row = self.dy_shape.row(s.image, channel, (s.row + down) as isize);
                if let Some(row) = row {
                    line::read(self.dy, row, s.column as isize, s.len + 1, &mut work.line);
                }
                for (shift, to) in SHIFTS.iter().zip(&mut work.rows) {
                    let to = &mut to[s.at..s.at + count];
                    match row {
                        _ if shift.0 != down => {}
                        Some(_) => to.copy_from_slice(&work.line[shift.1..shift.1 + count]),
                        None => to.fill(0.0),
                    }
                }
            }
        }
        for (k, from) in work.rows[..SHIFTS.len()].iter().enumerate() {
            panel[k * self.inputs() + channel].copy_from_slice(&from[..PIXELS]);
        }
    }

    #[inline(always)]
    fn write<'r, S: Simd>(
        &self,
        _: S,
        segments: &[Segment],
        channel: usize,
        products: impl Fn(usize) -> &'r Row,
        work: &mut Work,
    ) {
        for (k, row) in work.rows[..4].iter_mut().enumerate() {
            row[..PIXELS].copy_from_slice(products(k));
        }
        // SAFETY: no tile is in two blocks, and one thread works on a block.
        unsafe { write_tiles::<2>(&self.dx, &self.dx_shape, channel, segments, work) };
    }
}
