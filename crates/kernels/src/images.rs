//! Reading and writing of batches of images in tiles.

use crate::blocks::Segment;
use crate::epilogue::Epilogue;
use crate::output::Shared;
use crate::registers::{ImageRow, deinterleave, interleave, load, load_row, prefetch, store, store_row};
use crate::tile::Row;
use pulp::Simd;

/// The shape of an image.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ImageShape {
    /// Channels of an image.
    pub channels: usize,
    /// Rows of an image.
    pub height: usize,
    /// Columns of an image.
    pub width: usize,
}

impl ImageShape {
    /// A row of a channel; none if `y` is outside the image.
    #[inline(always)]
    pub fn row(&self, image: usize, channel: usize, y: isize) -> Option<ImageRow> {
        let inside = y >= 0 && (y as usize) < self.height;
        let start = || ((image * self.channels + channel) * self.height + y as usize) * self.width;
        inside.then(|| ImageRow { start: start(), width: self.width })
    }
}

/// Images for reading.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Images<'a> {
    /// `[batch, channels, height, width]`.
    pub values: &'a [f32],
    /// Shape of one image.
    pub shape: ImageShape,
}

impl Images<'_> {
    /// Every M-th pixel of a row, from `first` on, which may be -1: register j has pixels `first + j`, `first + j + M`,
    /// ... Pixels outside the row are zero.
    #[inline(always)]
    pub fn every<S: Simd, const M: usize>(&self, simd: S, row: Option<ImageRow>, first: isize) -> [S::f32s; M] {
        let mut pixels = [simd.splat_f32s(0.0); M];
        let Some(row) = row else { return pixels };
        for (k, pixels) in pixels.iter_mut().enumerate() {
            *pixels = load(simd, self.values, row, first + (k * S::F32_LANES) as isize);
        }
        deinterleave(simd, pixels)
    }

    /// Prefetches the pixels of a channel that a later block reads: `rows` rows of each tile, the first one `above`
    /// rows above the tile. A tile is `size` pixels wide.
    #[inline(always)]
    pub fn prefetch(&self, segments: &[Segment], channel: usize, size: usize, (above, rows): (usize, usize)) {
        prefetch_tiles(self.values.as_ptr(), &self.shape, segments, channel, size, (above, rows));
    }

    /// The `M x M` pixels of each tile of a block in one channel: pixel `(i, j)` to `panel[i * M + j]`.
    #[inline(always)]
    pub fn read_tiles<S: Simd, const M: usize>(
        &self,
        simd: S,
        segments: &[Segment],
        channel: usize,
        panel: &mut [Row],
    ) {
        for s in segments {
            for i in 0..M {
                let row = self.shape.row(s.image, channel, (s.row * M + i) as isize);
                for group in (0..s.len).step_by(S::F32_LANES) {
                    let pixels: [S::f32s; M] = self.every(simd, row, ((s.column + group) * M) as isize);
                    for (j, values) in pixels.into_iter().enumerate() {
                        store_row(simd, &mut panel[i * M + j], s.at + group, values);
                    }
                }
            }
        }
    }
}

/// Floats in a cache line.
const LINE: usize = 16;

#[inline(always)]
fn prefetch_tiles(
    values: *const f32,
    shape: &ImageShape,
    segments: &[Segment],
    channel: usize,
    size: usize,
    (above, rows): (usize, usize),
) {
    for s in segments {
        for y in 0..rows {
            if let Some(row) = shape.row(s.image, channel, (s.row * size + y) as isize - above as isize) {
                for pixel in (s.column * size..(s.column + s.len) * size + LINE).step_by(LINE) {
                    prefetch(values.wrapping_add(row.start + pixel));
                }
            }
        }
    }
}

/// Images that several threads write.
#[derive(Clone, Copy)]
pub(crate) struct ImagesOut<'a> {
    /// `[batch, channels, height, width]`.
    pub values: Shared<'a>,
    /// Shape of one image.
    pub shape: ImageShape,
    /// Applied to each value before it is written.
    pub epilogue: Epilogue<'a>,
}

impl ImagesOut<'_> {
    /// As [`Images::prefetch`], for tiles of `size` x `size` pixels that will be written.
    #[inline(always)]
    pub fn prefetch(&self, segments: &[Segment], channel: usize, size: usize) {
        prefetch_tiles(self.values.start(), &self.shape, segments, channel, size, (0, size));
    }

    /// Writes the `M x M` pixels of one channel for the tiles of a segment from tile `group` on, one register of tiles
    /// per pixel.
    ///
    /// # Safety
    /// No other thread writes these tiles.
    #[inline(always)]
    pub unsafe fn write_tiles<S: Simd, const M: usize>(
        &self,
        simd: S,
        (segment, group): (&Segment, usize),
        channel: usize,
        tiles: [[S::f32s; M]; M],
    ) {
        let (begin, end) = ((segment.column + group) * M, (segment.column + segment.len) * M);
        for (i, mut pixels) in tiles.into_iter().enumerate() {
            let Some(row) = self.shape.row(segment.image, channel, (segment.row * M + i) as isize) else { continue };
            for pixel in &mut pixels {
                *pixel = self.epilogue.apply(simd, channel, *pixel);
            }
            for (k, values) in interleave(simd, pixels).into_iter().enumerate() {
                // SAFETY: required of the caller.
                unsafe { store(simd, &self.values, row, (begin + k * S::F32_LANES, end), values) };
            }
        }
    }

    /// Writes the `M x M` pixels of all tiles of a block in one channel, pixel `(i, j)` from `rows(i * M + j)`.
    ///
    /// # Safety
    /// No other thread writes these tiles.
    #[inline(always)]
    pub unsafe fn write_rows<'r, S: Simd, const M: usize>(
        &self,
        simd: S,
        segments: &[Segment],
        channel: usize,
        rows: impl Fn(usize) -> &'r Row,
    ) {
        for segment in segments {
            for group in (0..segment.len).step_by(S::F32_LANES) {
                let mut tiles = [[simd.splat_f32s(0.0); M]; M];
                for (k, pixel) in tiles.as_flattened_mut().iter_mut().enumerate() {
                    *pixel = load_row(simd, rows(k), segment.at + group);
                }
                // SAFETY: required of the caller.
                unsafe { self.write_tiles(simd, (segment, group), channel, tiles) };
            }
        }
    }
}
