//! The convolution as one product with the nine neighbours of each pixel.

use super::Conv3x3;
use crate::blocks::{Segment, TileGrid};
use crate::epilogue::Epilogue;
use crate::images::{ImageShape, Work, rounded, write_tiles};
use crate::line;
use crate::output::Shared;
use crate::scheme::{PackedWeights, Scheme};
use crate::tile::{PIXELS, Row};
use pulp::Simd;
use std::ops::Range;

/// A tile is one pixel of the output.
pub(super) struct Direct<'a, const STRIDE: usize> {
    batch: usize,
    x: &'a [f32],
    x_shape: ImageShape,
    y: Shared<'a>,
    y_shape: ImageShape,
    epilogue: Epilogue<'a>,
}

impl<'a, const STRIDE: usize> Direct<'a, STRIDE> {
    /// `y` is written to; nothing else may be writing there.
    pub fn new(conv: &Conv3x3, x: &'a [f32], y: Shared<'a>, epilogue: Epilogue<'a>) -> Self {
        let x_shape = ImageShape { channels: conv.inputs, height: conv.height, width: conv.width };
        let y_shape = ImageShape { channels: conv.outputs, height: conv.out_height(), width: conv.out_width() };
        Direct { batch: conv.batch, x, x_shape, y, y_shape, epilogue }
    }
}

/// Weights in the order of [`read_neighbours`]; `kernel(output, input)` gives those of one pair of channels.
pub(super) fn pack(inputs: usize, outputs: usize, kernel: impl Fn(usize, usize) -> [f32; 9] + Sync) -> PackedWeights {
    PackedWeights::new(outputs, inputs * 9, |output, put| {
        for input in 0..inputs {
            for (tap, weight) in kernel(output, input).into_iter().enumerate() {
                put(input * 9 + tap, weight);
            }
        }
    })
}

/// The neighbours of each pixel of a block in one channel: `panel[ky * 3 + kx]`.
#[inline(always)]
pub(super) fn read_neighbours<const STRIDE: usize>(
    (x, shape): (&[f32], &ImageShape),
    segments: &[Segment],
    channel: usize,
    panel: &mut [Row],
    work: &mut Work,
) {
    for s in segments {
        let count = rounded(s);
        for ky in 0..3 {
            let mut rows = work.rows[ky * 3..].iter_mut();
            let mut to: [&mut [f32]; 3] =
                std::array::from_fn(|_| rows.next().map_or(&mut [][..], |r| &mut r[s.at..s.at + count]));
            let Some(row) = shape.row(s.image, channel, (s.row * STRIDE + ky) as isize - 1) else {
                to.iter_mut().for_each(|row| row.fill(0.0));
                continue;
            };
            line::read(x, row, (s.column * STRIDE) as isize - 1, (s.len - 1) * STRIDE + 3, &mut work.line);
            if STRIDE == 1 {
                for (kx, to) in to.iter_mut().enumerate() {
                    to.copy_from_slice(&work.line[kx..kx + count]);
                }
            } else {
                let pixels = work.line.as_chunks::<2>().0;
                for (t, (own, next)) in pixels[..count].iter().zip(&pixels[1..count + 1]).enumerate() {
                    (to[0][t], to[1][t], to[2][t]) = (own[0], own[1], next[0]);
                }
            }
        }
    }
    for (to, from) in panel[..9].iter_mut().zip(&work.rows) {
        to.copy_from_slice(&from[..PIXELS]);
    }
}

impl<const STRIDE: usize> Scheme for Direct<'_, STRIDE> {
    fn grid(&self) -> TileGrid {
        TileGrid { batch: self.batch, rows: self.y_shape.height, columns: self.y_shape.width }
    }

    fn inputs(&self) -> usize {
        self.x_shape.channels
    }

    fn outputs(&self) -> usize {
        self.y_shape.channels
    }

    fn panel_rows(&self) -> usize {
        9 * self.inputs()
    }

    fn products(&self) -> Vec<Range<usize>> {
        std::iter::once(0..self.panel_rows()).collect()
    }

    #[inline(always)]
    fn read<S: Simd>(&self, _: S, segments: &[Segment], channel: usize, panel: &mut [Row], work: &mut Work) {
        read_neighbours::<STRIDE>((self.x, &self.x_shape), segments, channel, &mut panel[channel * 9..], work);
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
        work.rows[0][..PIXELS].copy_from_slice(products(0));
        self.epilogue.apply(channel, &mut work.rows[0][..PIXELS]);
        // SAFETY: no pixel is in two blocks, and one thread works on a block.
        unsafe { write_tiles::<1>(&self.y, &self.y_shape, channel, segments, work) };
    }
}
