//! Gradient with respect to the input of a convolution of stride 2 at some of its pixels: at the pillars of a canvas,
//! which are few. As [`super::strided_gradient`], but a block has 32 pixels of any places, all of them at the same
//! place of their tile of 2 x 2, so that the same taps contribute to them.

use super::Conv3x3;
use super::strided_gradient::{PRODUCTS, SHIFTS, pack_taps};
use crate::blocks::{Segment, TileGrid};
use crate::images::Images;
use crate::output::Shared;
use crate::scheme::{PackedWeights, Scheme};
use crate::tile::Row;
use pulp::Simd;
use std::ops::Range;

/// A pixel at which the gradient is wanted.
#[derive(Clone, Copy, Debug)]
struct Pixel {
    /// Its number, in the order of the result.
    number: u32,
    /// Position of its tile in `dy`, channel 0.
    at: usize,
    /// Whether the tile has a row of `dy` below it, and a column to its right.
    has: (bool, bool),
}

/// The pixels at one place of their tiles, sorted by tile.
pub(super) struct PixelGradient<'a> {
    dy: Images<'a>,
    pixels: Vec<Pixel>,
    shifts: Range<usize>,
    /// `[pixels, inputs]`; no other code may write to it.
    dx: Shared<'a>,
    inputs: usize,
}

/// The pixels `cells`, indices into `[batch, height, width]`, by their place in the tile, with the weights of this
/// place.
pub(super) fn by_place<'a>(
    conv: &Conv3x3,
    dy: Images<'a>,
    cells: &[u32],
    dx: Shared<'a>,
    weight: &[f32],
) -> Vec<(PixelGradient<'a>, PackedWeights)> {
    let mut pixels: [Vec<Pixel>; 4] = Default::default();
    let mut sorted: Vec<(u32, u32)> = cells.iter().copied().zip(0..).collect();
    sorted.sort_unstable();
    for (cell, number) in sorted {
        let (line, x) = (cell as usize / conv.width, cell as usize % conv.width);
        let (image, y) = (line / conv.height, line % conv.height);
        let at = (image * dy.shape.channels * dy.shape.height + y / 2) * dy.shape.width + x / 2;
        let has = (y / 2 + 1 < dy.shape.height, x / 2 + 1 < dy.shape.width);
        pixels[y % 2 * 2 + x % 2].push(Pixel { number, at, has });
    }
    let places = pixels.into_iter().zip(PRODUCTS).filter(|(pixels, _)| !pixels.is_empty());
    let with_weights = |(pixels, (shifts, taps)): (Vec<Pixel>, (Range<usize>, &[usize]))| {
        let gradient = PixelGradient { dy, pixels, shifts, dx, inputs: conv.inputs };
        (gradient, pack_taps(conv, weight, taps))
    };
    places.map(with_weights).collect()
}

impl PixelGradient<'_> {
    /// The pixels of a block and their places in it.
    #[inline(always)]
    fn of_block(&self, segments: &[Segment]) -> impl Iterator<Item = (usize, &Pixel)> {
        let of_segment = |s: &Segment| (s.at..).zip(&self.pixels[s.column..s.column + s.len]);
        segments.iter().flat_map(of_segment)
    }
}

impl Scheme for PixelGradient<'_> {
    fn grid(&self) -> TileGrid {
        TileGrid { batch: 1, rows: 1, columns: self.pixels.len() }
    }

    fn inputs(&self) -> usize {
        self.dy.shape.channels
    }

    fn outputs(&self) -> usize {
        self.inputs
    }

    fn panel_rows(&self) -> usize {
        self.shifts.len() * self.dy.shape.channels
    }

    fn products(&self) -> Vec<Range<usize>> {
        std::iter::once(0..self.panel_rows()).collect()
    }

    fn prefetch_input(&self, _: &[Segment], _: usize) {}

    fn prefetch_output(&self, _: &[Segment], _: usize) {}

    #[inline(always)]
    fn read<S: Simd>(&self, _: S, segments: &[Segment], channel: usize, panel: &mut [Row]) {
        let (width, plane) = (self.dy.shape.width, self.dy.shape.height * self.dy.shape.width);
        for (k, (down, right)) in SHIFTS[self.shifts.clone()].iter().enumerate() {
            let row = &mut panel[k * self.dy.shape.channels + channel];
            *row = Row::default();
            for (t, pixel) in self.of_block(segments) {
                let inside = (*down == 0 || pixel.has.0) && (*right == 0 || pixel.has.1);
                row[t] = if inside { self.dy.values[pixel.at + channel * plane + down * width + right] } else { 0.0 };
            }
        }
    }

    #[inline(always)]
    fn write<'r, S: Simd>(&self, _: S, segments: &[Segment], channel: usize, products: impl Fn(usize) -> &'r Row) {
        for (t, pixel) in self.of_block(segments) {
            // SAFETY: no pixel is in two blocks, and one thread works on a block.
            unsafe { self.dx.write(pixel.number as usize * self.inputs + channel, &products(0)[t..=t]) };
        }
    }
}
