//! The convolution of stride 1 by Winograd's minimal filtering: a product for each of the A x A values of a transformed tile.

use super::Conv3x3;
use super::winograd::{Winograd, transform_kernel};
use crate::blocks::{Segment, TileGrid};
use crate::epilogue::Epilogue;
use crate::images::{ImageShape, Work, rounded, write_tiles};
use crate::line;
use crate::output::Shared;
use crate::scheme::{PackedWeights, Scheme};
use crate::simd::Lanes;
use crate::tile::{PIXELS, Row};
use pulp::Simd;
use std::marker::PhantomData;
use std::ops::Range;

/// A tile is M x M pixels of the output.
pub(super) struct WinogradProduct<'a, F, const M: usize, const A: usize> {
    batch: usize,
    x: &'a [f32],
    x_shape: ImageShape,
    y: Shared<'a>,
    y_shape: ImageShape,
    epilogue: Epilogue<'a>,
    transforms: PhantomData<F>,
}

impl<'a, F: Winograd<M, A>, const M: usize, const A: usize> WinogradProduct<'a, F, M, A> {
    /// `y` is written to; nothing else may be writing there.
    pub fn new(conv: &Conv3x3, x: &'a [f32], y: Shared<'a>, epilogue: Epilogue<'a>) -> Self {
        let shape = |channels| ImageShape { channels, height: conv.height, width: conv.width };
        let (x_shape, y_shape) = (shape(conv.inputs), shape(conv.outputs));
        WinogradProduct { batch: conv.batch, x, x_shape, y, y_shape, epilogue, transforms: PhantomData }
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
    PackedWeights::new(outputs, A * A * inputs, |output, put| {
        for input in 0..inputs {
            let u = transform_kernel::<F, M, A>(&kernel(output, input));
            for (position, &value) in u.as_flattened().iter().enumerate() {
                put(position * inputs + input, value);
            }
        }
    })
}

/// B^T d B of one channel of the tiles of a block. Value `(i, j)` of each tile goes to `panel[(i * A + j) * stride]`.
#[inline(always)]
pub(super) fn read_tiles<S: Simd, F: Winograd<M, A>, const M: usize, const A: usize>(
    simd: S,
    (x, shape): (&[f32], &ImageShape),
    segments: &[Segment],
    channel: usize,
    panel: &mut [Row],
    stride: usize,
    work: &mut Work,
) {
    for s in segments {
        let count = rounded(s);
        for i in 0..A {
            let mut rows = work.rows[i * A..].iter_mut();
            let mut to: [&mut [f32]; A] =
                std::array::from_fn(|_| rows.next().map_or(&mut [][..], |r| &mut r[s.at..s.at + count]));
            let Some(row) = shape.row(s.image, channel, (s.row * M + i) as isize - 1) else {
                to.iter_mut().for_each(|row| row.fill(0.0));
                continue;
            };
            line::read(x, row, (s.column * M) as isize - 1, s.len * M + 2, &mut work.line);
            let pixels = work.line.as_chunks::<M>().0;
            for (t, (own, next)) in pixels[..count].iter().zip(&pixels[1..count + 1]).enumerate() {
                let d = F::input(std::array::from_fn(|j| if j < M { own[j] } else { next[j - M] }));
                for j in 0..A {
                    to[j][t] = d[j];
                }
            }
        }
    }
    for j in 0..A {
        for group in 0..PIXELS / S::F32_LANES {
            let column = std::array::from_fn(|i| Lanes::new(simd, S::as_simd_f32s(&work.rows[i * A + j]).0[group]));
            for (i, value) in F::input(column).into_iter().enumerate() {
                S::as_mut_simd_f32s(&mut panel[(i * A + j) * stride]).0[group] = value.values;
            }
        }
    }
}

impl<F: Winograd<M, A>, const M: usize, const A: usize> Scheme for WinogradProduct<'_, F, M, A> {
    fn grid(&self) -> TileGrid {
        tiles::<M>(self.batch, self.x_shape.height, self.x_shape.width)
    }

    fn inputs(&self) -> usize {
        self.x_shape.channels
    }

    fn outputs(&self) -> usize {
        self.y_shape.channels
    }

    fn panel_rows(&self) -> usize {
        // One row is left free behind each value, else all of them meet in the same places of the cache.
        A * A * (self.inputs() + 1)
    }

    fn products(&self) -> Vec<Range<usize>> {
        (0..A * A).map(|p| p * (self.inputs() + 1)..p * (self.inputs() + 1) + self.inputs()).collect()
    }

    #[inline(always)]
    fn read<S: Simd>(&self, simd: S, segments: &[Segment], channel: usize, panel: &mut [Row], work: &mut Work) {
        let (image, stride) = ((self.x, &self.x_shape), self.inputs() + 1);
        read_tiles::<S, F, M, A>(simd, image, segments, channel, &mut panel[channel..], stride, work);
    }

    #[inline(always)]
    fn write<'r, S: Simd>(
        &self,
        simd: S,
        segments: &[Segment],
        channel: usize,
        products: impl Fn(usize) -> &'r Row,
        work: &mut Work,
    ) {
        for group in 0..PIXELS / S::F32_LANES {
            let value = |i, j| Lanes::new(simd, S::as_simd_f32s(products(i * A + j)).0[group]);
            let columns: [[Lanes<S>; M]; A] = std::array::from_fn(|j| F::output(std::array::from_fn(|i| value(i, j))));
            for i in 0..M {
                for (j, pixel) in F::output(std::array::from_fn(|j| columns[j][i])).into_iter().enumerate() {
                    S::as_mut_simd_f32s(&mut work.rows[i * M + j]).0[group] = pixel.values;
                }
            }
        }
        for row in &mut work.rows[..M * M] {
            self.epilogue.apply(channel, &mut row[..PIXELS]);
        }
        // SAFETY: no tile is in two blocks, and one thread works on a block.
        unsafe { write_tiles::<M>(&self.y, &self.y_shape, channel, segments, work) };
    }
}
