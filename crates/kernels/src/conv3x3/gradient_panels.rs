//! The two factors of the gradient with respect to the weights, for each convolution algorithm.

use super::direct::read_neighbours;
use super::winograd::{Winograd, transform_kernel_back};
use super::winograd_product::{read_tiles, tiles};
use crate::blocks::{Segment, TileGrid};
use crate::images::Images;
use crate::simd::Lanes;
use crate::tile::Row;
use crate::weight_gradient::Panels;
use pulp::Simd;
use std::marker::PhantomData;

/// The tensors of a convolution.
#[derive(Clone, Copy)]
pub(super) struct Factors<'a> {
    pub batch: usize,
    pub x: Images<'a>,
    pub dy: Images<'a>,
}

impl Factors<'_> {
    fn weight_at(&self, input: usize, output: usize) -> usize {
        (output * self.x.shape.channels + input) * 9
    }
}

/// Transformed tiles: the transpose of Winograd's minimal filtering.
pub(super) struct WinogradPanels<'a, F, const M: usize, const A: usize> {
    pub factors: Factors<'a>,
    pub transforms: PhantomData<F>,
}

impl<F: Winograd<M, A>, const M: usize, const A: usize> Panels for WinogradPanels<'_, F, M, A> {
    const POSITIONS: usize = A * A;
    const X_SHARED: bool = false;
    const ROWS: usize = 1;
    const TILE: usize = M;
    const TAPS: usize = 9;

    fn grid(&self) -> TileGrid {
        tiles::<M>(self.factors.batch, self.factors.x.shape.height, self.factors.x.shape.width)
    }

    fn inputs(&self) -> usize {
        self.factors.x.shape.channels
    }

    fn dy(&self) -> Images<'_> {
        self.factors.dy
    }

    fn weight_at(&self, input: usize, output: usize) -> usize {
        self.factors.weight_at(input, output)
    }

    #[inline(always)]
    fn prefetch_x(&self, segments: &[Segment], input: usize) {
        self.factors.x.prefetch(segments, input, M, (1, A));
    }

    #[inline(always)]
    fn read_x<S: Simd>(&self, simd: S, segments: &[Segment], input: usize, panel: &mut [Row], stride: usize) {
        read_tiles::<S, F, M, A>(simd, &self.factors.x, segments, input, panel, stride);
    }

    #[inline(always)]
    fn transform_dy<S: Simd>(&self, simd: S, pixels: &[f32], columns: usize, to: &mut [f32], step: usize) {
        let zero = Lanes::new(simd, simd.splat_f32s(0.0));
        for at in (0..columns).step_by(S::F32_LANES) {
            let mut down = [[zero; A]; M];
            for (j, to) in down.iter_mut().enumerate() {
                let mut column = [zero; M];
                for (i, value) in column.iter_mut().enumerate() {
                    let pixel = &pixels[(i * M + j) * columns + at..][..S::F32_LANES];
                    value.values = S::as_simd_f32s(pixel).0[0];
                }
                *to = F::gradient(column);
            }
            for i in 0..A {
                let mut row = [zero; M];
                for j in 0..M {
                    row[j] = down[j][i];
                }
                for (j, value) in F::gradient(row).into_iter().enumerate() {
                    let to = &mut to[(i * A + j) * step + at..][..S::F32_LANES];
                    S::as_mut_simd_f32s(to).0[0] = value.values;
                }
            }
        }
    }

    #[inline(always)]
    fn finish<S: Simd>(&self, simd: S, sums: &[S::f32s], taps: &mut [S::f32s]) {
        let mut u = [[Lanes::new(simd, simd.splat_f32s(0.0)); A]; A];
        for (u, &sum) in u.as_flattened_mut().iter_mut().zip(sums) {
            u.values = sum;
        }
        for (tap, weight) in taps.iter_mut().zip(transform_kernel_back::<F, _, M, A>(&u)) {
            *tap = weight.values;
        }
    }
}

/// The nine neighbours of each pixel.
pub(super) struct DirectPanels<'a, const STRIDE: usize>(pub Factors<'a>);

impl<const STRIDE: usize> Panels for DirectPanels<'_, STRIDE> {
    const POSITIONS: usize = 1;
    const X_SHARED: bool = false;
    const ROWS: usize = 9;
    const TILE: usize = 1;
    const TAPS: usize = 9;

    fn grid(&self) -> TileGrid {
        TileGrid { batch: self.0.batch, rows: self.0.dy.shape.height, columns: self.0.dy.shape.width }
    }

    fn inputs(&self) -> usize {
        self.0.x.shape.channels
    }

    fn dy(&self) -> Images<'_> {
        self.0.dy
    }

    fn weight_at(&self, input: usize, output: usize) -> usize {
        self.0.weight_at(input, output)
    }

    #[inline(always)]
    fn prefetch_x(&self, segments: &[Segment], input: usize) {
        self.0.x.prefetch(segments, input, STRIDE, (1, 3));
    }

    #[inline(always)]
    fn read_x<S: Simd>(&self, simd: S, segments: &[Segment], input: usize, panel: &mut [Row], _: usize) {
        read_neighbours::<S, STRIDE>(simd, &self.0.x, segments, input, panel);
    }
}
