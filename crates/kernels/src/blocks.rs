//! A batch of images divided into blocks of [`PIXELS`] tiles.

use crate::tile::PIXELS;

/// Tiles in the order of images, rows and columns.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TileGrid {
    /// Images.
    pub batch: usize,
    /// Rows of tiles in an image.
    pub rows: usize,
    /// Tiles in a row.
    pub columns: usize,
}

/// Adjacent tiles of a block in one row of an image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Segment {
    /// The image.
    pub image: usize,
    /// The row of tiles.
    pub row: usize,
    /// The first tile.
    pub column: usize,
    /// Number of tiles.
    pub len: usize,
    /// Position of the first tile in the block.
    pub at: usize,
}

/// The segments of one block.
pub(crate) struct Segments {
    all: [Segment; PIXELS],
    count: usize,
}

impl Segments {
    /// In the order of their positions.
    #[inline(always)]
    pub fn list(&self) -> &[Segment] {
        &self.all[..self.count]
    }

    /// Tiles in the block.
    pub fn tiles(&self) -> usize {
        self.list().last().map_or(0, |last| last.at + last.len)
    }
}

impl TileGrid {
    /// Tiles in all images.
    pub fn tiles(&self) -> usize {
        self.batch * self.rows * self.columns
    }

    /// Blocks of [`PIXELS`] tiles; the last may have fewer.
    pub fn blocks(&self) -> usize {
        self.tiles().div_ceil(PIXELS)
    }

    /// The segments of a block; empty after the last block.
    pub fn segments(&self, block: usize) -> Segments {
        let mut segments = Segments { all: [Segment::default(); PIXELS], count: 0 };
        let (from, to) = (block * PIXELS, self.tiles().min((block + 1) * PIXELS));
        let mut tile = from;
        while tile < to {
            let (line, column) = (tile / self.columns, tile % self.columns);
            let len = (self.columns - column).min(to - tile);
            let (image, row) = (line / self.rows, line % self.rows);
            segments.all[segments.count] = Segment { image, row, column, len, at: tile - from };
            segments.count += 1;
            tile += len;
        }
        segments
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_tile_is_in_one_segment() {
        for (batch, rows, columns) in [(1, 1, 1), (2, 3, 5), (1, 2, 40), (3, 7, 32), (0, 4, 4), (1, 70, 1)] {
            let grid = TileGrid { batch, rows, columns };
            let mut seen = vec![0; grid.tiles()];
            for block in 0..grid.blocks() {
                let segments = grid.segments(block);
                let mut at = 0;
                for s in segments.list() {
                    assert_eq!(s.at, at);
                    at += s.len;
                    for t in 0..s.len {
                        seen[(s.image * rows + s.row) * columns + s.column + t] += 1;
                    }
                }
                assert_eq!(segments.tiles(), at);
            }
            assert!(seen.iter().all(|&n| n == 1));
        }
    }
}
