//! The convolution of stride 1 by Winograd's minimal filtering: a product for each of the A x A values of a transformed
//! tile.

use super::winograd::{Winograd, transform_kernel};
use crate::blocks::{Segment, TileGrid};
use crate::images::{Images, ImagesOut};
use crate::registers::{load_row, store_row};
use crate::scheme::{PackedWeights, Scheme};
use crate::simd::Lanes;
use crate::tile::Row;
use pulp::Simd;
use std::marker::PhantomData;
use std::ops::Range;

/// A tile is M x M pixels of the output.
pub(super) struct WinogradProduct<'a, F, const M: usize, const A: usize> {
    batch: usize,
    x: Images<'a>,
    y: ImagesOut<'a>,
    transforms: PhantomData<F>,
}

impl<'a, F: Winograd<M, A>, const M: usize, const A: usize> WinogradProduct<'a, F, M, A> {
    /// No other code may write to `y`.
    pub fn new(batch: usize, x: Images<'a>, y: ImagesOut<'a>) -> Self {
        WinogradProduct { batch, x, y, transforms: PhantomData }
    }
}

/// The tiles of images of `height` and `width`.
pub(super) fn tiles<const M: usize>(batch: usize, height: usize, width: usize) -> TileGrid {
    TileGrid { batch, rows: height.div_ceil(M), columns: width.div_ceil(M) }
}

/// Transformed weights; `kernel(output, input)` gives those of one pair of channels.
pub(super) fn pack<F: Winograd<M, A>, const M: usize, const A: usize>(
    inputs: usize,
    outputs: usize,
    kernel: impl Fn(usize, usize) -> [f32; 9] + Sync,
) -> PackedWeights {
    PackedWeights::new(outputs, A * A * inputs, |output, insert| {
        for input in 0..inputs {
            let u = transform_kernel::<F, M, A>(&kernel(output, input));
            for (position, &value) in u.as_flattened().iter().enumerate() {
                insert(position * inputs + input, value);
            }
        }
    })
}

/// B^T d B of one channel of the tiles of a block. Value `(i, j)` of each tile goes to `panel[(i * A + j) * stride]`.
#[inline(always)]
pub(super) fn read_tiles<S: Simd, F: Winograd<M, A>, const M: usize, const A: usize>(
    simd: S,
    x: &Images<'_>,
    segments: &[Segment],
    channel: usize,
    panel: &mut [Row],
    stride: usize,
) {
    let zero = Lanes::new(simd, simd.splat_f32s(0.0));
    for s in segments {
        for group in (0..s.len).step_by(S::F32_LANES) {
            let first = ((s.column + group) * M) as isize - 1;
            let mut rows = [[zero; A]; A]; // B^T of each row
            for (i, to) in rows.iter_mut().enumerate() {
                let row = x.shape.row(s.image, channel, (s.row * M + i) as isize - 1);
                let own: [S::f32s; M] = x.every(simd, row, first);
                let next: [S::f32s; M] = x.every(simd, row, first + M as isize);
                let mut d = [zero; A];
                for j in 0..A {
                    d[j].values = if j < M { own[j] } else { next[j - M] };
                }
                *to = F::input(d);
            }
            for j in 0..A {
                let mut column = [zero; A];
                for i in 0..A {
                    column[i] = rows[i][j];
                }
                for (i, value) in F::input(column).into_iter().enumerate() {
                    store_row(simd, &mut panel[(i * A + j) * stride], s.at + group, value.values);
                }
            }
        }
    }
}

impl<F: Winograd<M, A>, const M: usize, const A: usize> Scheme for WinogradProduct<'_, F, M, A> {
    fn grid(&self) -> TileGrid {
        tiles::<M>(self.batch, self.x.shape.height, self.x.shape.width)
    }

    fn inputs(&self) -> usize {
        self.x.shape.channels
    }

    fn outputs(&self) -> usize {
        self.y.shape.channels
    }

    fn panel_rows(&self) -> usize {
        // One padding row after each value avoids cache conflicts.
        A * A * (self.inputs() + 1)
    }

    fn products(&self) -> Vec<Range<usize>> {
        (0..A * A).map(|p| p * (self.inputs() + 1)..p * (self.inputs() + 1) + self.inputs()).collect()
    }

    #[inline(always)]
    fn prefetch_input(&self, segments: &[Segment], channel: usize) {
        self.x.prefetch(segments, channel, M, (1, A));
    }

    #[inline(always)]
    fn prefetch_output(&self, segments: &[Segment], channel: usize) {
        self.y.prefetch(segments, channel, M);
    }

    #[inline(always)]
    fn read<S: Simd>(&self, simd: S, segments: &[Segment], channel: usize, panel: &mut [Row]) {
        let stride = self.inputs() + 1;
        read_tiles::<S, F, M, A>(simd, &self.x, segments, channel, &mut panel[channel..], stride);
    }

    #[inline(always)]
    fn write<'r, S: Simd>(&self, simd: S, segments: &[Segment], channel: usize, products: impl Fn(usize) -> &'r Row) {
        let zero = Lanes::new(simd, simd.splat_f32s(0.0));
        for s in segments {
            for group in (0..s.len).step_by(S::F32_LANES) {
                let mut columns = [[zero; M]; A]; // A^T of each column
                for (j, to) in columns.iter_mut().enumerate() {
                    let mut column = [zero; A];
                    for (i, value) in column.iter_mut().enumerate() {
                        value.values = load_row(simd, products(i * A + j), s.at + group);
                    }
                    *to = F::output(column);
                }
                let mut tiles = [[zero.values; M]; M];
                for (i, to) in tiles.iter_mut().enumerate() {
                    let mut row = [zero; A];
                    for j in 0..A {
                        row[j] = columns[j][i];
                    }
                    for (to, pixel) in to.iter_mut().zip(F::output(row)) {
                        *to = pixel.values;
                    }
                }
                // SAFETY: no tile is in two blocks, and one thread works on a block.
                unsafe { self.y.write_tiles(simd, (s, group), channel, tiles) };
            }
        }
    }
}
