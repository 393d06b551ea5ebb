//! Runs of pixels in and out of the rows of an image.

use crate::output::Shared;
use crate::tile::PIXELS;

/// Pixels that a run may have: those of [`PIXELS`] tiles, 4 wide, their neighbours, and the rounding of [`read`].
pub(crate) const LINE: usize = 4 * PIXELS + 32;

/// A run of pixels.
pub(crate) type Line = [f32; LINE];

/// Values are copied in groups of this many.
const GROUP: usize = 16;

/// A row of one channel of one image within a tensor.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ImageRow {
    /// Place of its first pixel.
    pub start: usize,
    /// Number of its pixels.
    pub width: usize,
}

/// Reads `count` pixels from `first` (-1 or more) on; beyond the ends of the row there are zeros. What follows them in `line` has no meaning.
#[inline(always)]
pub(crate) fn read(tensor: &[f32], row: ImageRow, first: isize, count: usize, line: &mut Line) {
    let groups = count.div_ceil(GROUP);
    let start = row.start as isize + first;
    if start >= 0 && start as usize + groups * GROUP <= tensor.len() {
        let from = &tensor[start as usize..][..groups * GROUP];
        for (to, from) in line.as_chunks_mut::<GROUP>().0.iter_mut().zip(from.as_chunks::<GROUP>().0) {
            *to = *from;
        }
        if first < 0 {
            line[0] = 0.0;
        }
        let end = (row.width as isize - first) as usize; // of the row, in the line
        if end < count {
            line[end..count].fill(0.0);
        }
    } else {
        // Near the ends of the tensor.
        for (k, value) in line[..count].iter_mut().enumerate() {
            let x = first + k as isize;
            *value = if x >= 0 && (x as usize) < row.width { tensor[row.start + x as usize] } else { 0.0 };
        }
    }
}

/// Writes the pixels from `first` on that are inside of the row.
///
/// # Safety
/// As [`Shared::write`].
#[inline(always)]
pub(crate) unsafe fn write(tensor: &Shared<'_>, row: ImageRow, first: usize, pixels: &[f32]) {
    let inside = pixels.len().min(row.width - first);
    // SAFETY: passed on to the caller.
    unsafe { tensor.write(row.start + first, &pixels[..inside]) };
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn zeros_beyond_the_ends() {
        for (width, rows) in [(1, 1), (3, 2), (40, 3), (200, 2)] {
            let tensor: Vec<f32> = (0..width * rows).map(|i| i as f32 + 1.0).collect();
            for row in 0..rows {
                for first in [-1isize, 0, 1, width as isize - 1] {
                    for count in [1, 3, 66, 130] {
                        let mut line = [7.0; LINE];
                        read(&tensor, ImageRow { start: row * width, width }, first, count, &mut line);
                        for (k, &got) in line[..count].iter().enumerate() {
                            let x = first + k as isize;
                            let inside = x >= 0 && x < width as isize;
                            let want = if inside { tensor[row * width + x as usize] } else { 0.0 };
                            assert_eq!(got, want, "width {width} row {row} first {first} pixel {k}");
                        }
                    }
                }
            }
        }
    }
}
