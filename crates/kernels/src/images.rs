//! Batches of images as the schemes read and write them.

use crate::blocks::Segment;
use crate::line::{self, ImageRow, LINE, Line};
use crate::output::Shared;
use crate::tile::PIXELS;

/// The shape `[batch, channels, height, width]` of a tensor.
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
    /// A row of a channel, if the image has it.
    #[inline(always)]
    pub fn row(&self, image: usize, channel: usize, y: isize) -> Option<ImageRow> {
        let inside = y >= 0 && (y as usize) < self.height;
        let start = || ((image * self.channels + channel) * self.height + y as usize) * self.width;
        inside.then(|| ImageRow { start: start(), width: self.width })
    }
}

/// Values of the tiles of a block, with room for the rounding of its last segment.
pub(crate) type WideRow = [f32; 2 * PIXELS];

/// Memory for one channel of one block.
pub(crate) struct Work {
    /// Pixels of a row.
    pub line: Line,
    /// One row a value of a tile; F(4x4, 3x3) has 36.
    pub rows: [WideRow; 36],
}

impl Work {
    /// Zeros.
    #[inline(always)]
    pub fn new() -> Self {
        Work { line: [0.0; LINE], rows: [[0.0; 2 * PIXELS]; 36] }
    }
}

/// The number of tiles that loops over a segment take: whole registers, which is more than the segment has. What they do beyond its end is
/// overwritten by the next segment.
#[inline(always)]
pub(crate) fn rounded(segment: &Segment) -> usize {
    segment.len.next_multiple_of(16)
}

/// Writes the tiles of `M x M` pixels of one channel; `work.rows[i * M + j]` has pixel `(i, j)` of each tile.
///
/// # Safety
/// As [`Shared::write`].
#[inline(always)]
pub(crate) unsafe fn write_tiles<const M: usize>(
    tensor: &Shared<'_>,
    shape: &ImageShape,
    channel: usize,
    segments: &[Segment],
    work: &mut Work,
) {
    for s in segments {
        let count = rounded(s);
        for i in 0..M {
            let Some(row) = shape.row(s.image, channel, (s.row * M + i) as isize) else { continue };
            let mut rows = work.rows[i * M..].iter();
            let pixels: [&[f32]; M] = std::array::from_fn(|_| rows.next().map_or(&[][..], |r| &r[s.at..s.at + count]));
            for (t, pixel) in work.line.as_chunks_mut::<M>().0[..count].iter_mut().enumerate() {
                *pixel = std::array::from_fn(|j| pixels[j][t]);
            }
            // SAFETY: passed on to the caller.
            unsafe { line::write(tensor, row, s.column * M, &work.line[..s.len * M]) };
        }
    }
}
