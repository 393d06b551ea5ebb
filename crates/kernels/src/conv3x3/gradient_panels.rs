//! The two factors of the gradient by the weights, for each way of computing a convolution.

use super::direct::read_neighbours;
use super::winograd::{Winograd, transform_kernel_back};
use super::winograd_product::{read_tiles, tiles};
use crate::blocks::{Segment, TileGrid};
use crate::images::{ImageShape, Work};
use crate::simd::Lanes;
use crate::tile::Row;
use crate::weight_gradient::Panels;
use pulp::Simd;
use std::marker::PhantomData;

/// The tensors of a convolution.
#[derive(Clone, Copy)]
pub(super) struct Factors<'a> {
    pub batch: usize,
    pub x: &'a [f32],
    pub x_shape: ImageShape,
    pub dy: &'a [f32],
    pub dy_shape: ImageShape,
}

impl Factors<'_> {
    fn weight_at(&self, input: usize, output: usize) -> usize {
        (output * self.x_shape.channels + input) * 9
    }
}

/// Transformed tiles: the transpose of the minimal filtering.
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
        tiles::<M>(self.factors.batch, self.factors.x_shape.height, self.factors.x_shape.width)
    }

    fn inputs(&self) -> usize {
        self.factors.x_shape.channels
    }

    fn dy(&self) -> (&[f32], &ImageShape) {
        (self.factors.dy, &self.factors.dy_shape)
    }

    fn weight_at(&self, input: usize, output: usize) -> usize {
        self.factors.weight_at(input, output)
    }

    #[inline(always)]
    fn read_x<S: Simd>(
        &self,
        simd: S,
        segments: &[Segment],
        input: usize,
        panel: &mut [Row],
        stride: usize,
        work: &mut Work,
    ) {
        let image = (self.factors.x, &self.factors.x_shape);
        read_tiles::<S, F, M, A>(simd, image, segments, input, panel, stride, work);
    }

    #[inline(always)]
    fn transform_dy<S: Simd>(&self, simd: S, pixels: &[f32], columns: usize, to: &mut [f32], step: usize) {
        for group in 0..columns / S::F32_LANES {
            let at = group * S::F32_LANES;
            let pixel = |i, j| {
                let pixel = &pixels[(i * M + j) * columns + at..][..S::F32_LANES];
                Lanes::new(simd, S::as_simd_f32s(pixel).0[0])
            };
            let down: [[Lanes<S>; A]; M] = std::array::from_fn(|j| F::gradient(std::array::from_fn(|i| pixel(i, j))));
            for i in 0..A {
                let row = F::gradient(std::array::from_fn(|j| down[j][i]));
                for (j, value) in row.into_iter().enumerate() {
                    let to = &mut to[(i * A + j) * step + at..][..S::F32_LANES];
                    S::as_mut_simd_f32s(to).0[0] = value.values;
                }
            }
        }
    }

    #[inline(always)]
    fn finish<S: Simd>(&self, simd: S, sums: &[S::f32s], taps: &mut [S::f32s]) {
        let u = std::array::from_fn(|i| std::array::from_fn(|j| Lanes::new(simd, sums[i * A + j])));
        taps.copy_from_slice(&transform_kernel_back::<F, _, M, A>(&u).map(|weight| weight.values));
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
        TileGrid { batch: self.0.batch, rows: self.0.dy_shape.height, columns: self.0.dy_shape.width }
    }

    fn inputs(&self) -> usize {
        self.0.x_shape.channels
    }

    fn dy(&self) -> (&[f32], &ImageShape) {
        (self.0.dy, &self.0.dy_shape)
    }

    fn weight_at(&self, input: usize, output: usize) -> usize {
        self.0.weight_at(input, output)
    }

    #[inline(always)]
    fn read_x<S: Simd>(&self, _: S, segments: &[Segment], input: usize, panel: &mut [Row], _: usize, work: &mut Work) {
        read_neighbours::<STRIDE>((self.0.x, &self.0.x_shape), segments, input, panel, work);
    }
}
