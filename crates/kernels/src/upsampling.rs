//! Matrix products over the channels of single pixels: one pixel maps to `M x M` pixels, or `M x M` pixels to one. With
//! `M = 1` this is a 1x1 convolution, otherwise a transposed convolution with kernel size equal to stride, and its
//! gradients.

use crate::blocks::{Segment, TileGrid};
use crate::images::{ImageShape, Images, ImagesOut};
use crate::scheme::{PackedWeights, Scheme};
use crate::tile::Row;
use crate::weight_gradient::Panels;
use pulp::Simd;
use std::ops::Range;

/// Maps each pixel of `x` to `M x M` pixels of `y`. No other code may write there.
pub(crate) struct Expand<'a, const M: usize> {
    pub batch: usize,
    pub x: Images<'a>,
    pub y: ImagesOut<'a>,
}

/// Weights of [`Expand`]; `weight(output, input, pixel)`.
pub(crate) fn pack_expand<const M: usize>(
    inputs: usize,
    outputs: usize,
    weight: impl Fn(usize, usize, usize) -> f32 + Sync,
) -> PackedWeights {
    PackedWeights::new(outputs, M * M * inputs, |output, insert| {
        for pixel in 0..M * M {
            for input in 0..inputs {
                insert(pixel * inputs + input, weight(output, input, pixel));
            }
        }
    })
}

fn grid(batch: usize, shape: &ImageShape) -> TileGrid {
    TileGrid { batch, rows: shape.height, columns: shape.width }
}

impl<const M: usize> Scheme for Expand<'_, M> {
    fn grid(&self) -> TileGrid {
        grid(self.batch, &self.x.shape)
    }

    fn inputs(&self) -> usize {
        self.x.shape.channels
    }

    fn outputs(&self) -> usize {
        self.y.shape.channels
    }

    fn panel_rows(&self) -> usize {
        self.inputs()
    }

    fn products(&self) -> Vec<Range<usize>> {
        vec![0..self.inputs(); M * M]
    }

    #[inline(always)]
    fn prefetch_input(&self, segments: &[Segment], channel: usize) {
        self.x.prefetch(segments, channel, 1, (0, 1));
    }

    #[inline(always)]
    fn prefetch_output(&self, segments: &[Segment], channel: usize) {
        self.y.prefetch(segments, channel, M);
    }

    #[inline(always)]
    fn read<S: Simd>(&self, simd: S, segments: &[Segment], channel: usize, panel: &mut [Row]) {
        self.x.read_tiles::<S, 1>(simd, segments, channel, &mut panel[channel..]);
    }

    #[inline(always)]
    fn write<'r, S: Simd>(&self, simd: S, segments: &[Segment], channel: usize, products: impl Fn(usize) -> &'r Row) {
        // SAFETY: no pixel of `x` is in two blocks, and one thread works on a block.
        unsafe { self.y.write_rows::<S, M>(simd, segments, channel, products) };
    }
}

/// Maps `M x M` pixels of `dy` to one pixel of `dx`. No other code may write there.
pub(crate) struct Gather<'a, const M: usize> {
    pub batch: usize,
    pub dy: Images<'a>,
    pub dx: ImagesOut<'a>,
}

/// Weights of [`Gather`]; `weight(channel of dx, channel of dy, pixel)`.
pub(crate) fn pack_gather<const M: usize>(
    dx_channels: usize,
    dy_channels: usize,
    weight: impl Fn(usize, usize, usize) -> f32 + Sync,
) -> PackedWeights {
    PackedWeights::new(dx_channels, dy_channels * M * M, |to, insert| {
        for from in 0..dy_channels {
            for pixel in 0..M * M {
                insert(from * M * M + pixel, weight(to, from, pixel));
            }
        }
    })
}

impl<const M: usize> Scheme for Gather<'_, M> {
    fn grid(&self) -> TileGrid {
        grid(self.batch, &self.dx.shape)
    }

    fn inputs(&self) -> usize {
        self.dy.shape.channels
    }

    fn outputs(&self) -> usize {
        self.dx.shape.channels
    }

    fn panel_rows(&self) -> usize {
        self.inputs() * M * M
    }

    fn products(&self) -> Vec<Range<usize>> {
        std::iter::once(0..self.panel_rows()).collect()
    }

    #[inline(always)]
    fn prefetch_input(&self, segments: &[Segment], channel: usize) {
        self.dy.prefetch(segments, channel, M, (0, M));
    }

    #[inline(always)]
    fn prefetch_output(&self, segments: &[Segment], channel: usize) {
        self.dx.prefetch(segments, channel, 1);
    }

    #[inline(always)]
    fn read<S: Simd>(&self, simd: S, segments: &[Segment], channel: usize, panel: &mut [Row]) {
        self.dy.read_tiles::<S, M>(simd, segments, channel, &mut panel[channel * M * M..]);
    }

    #[inline(always)]
    fn write<'r, S: Simd>(&self, simd: S, segments: &[Segment], channel: usize, products: impl Fn(usize) -> &'r Row) {
        // SAFETY: no pixel of `dx` is in two blocks, and one thread works on a block.
        unsafe { self.dx.write_rows::<S, 1>(simd, segments, channel, products) };
    }
}

/// The factors of the gradient with respect to the weights of [`Expand`].
pub(crate) struct PixelPanels<'a, const M: usize, W> {
    pub batch: usize,
    pub x: Images<'a>,
    pub dy: Images<'a>,
    /// Index of the first weight of (input, output).
    pub weight_at: W,
}

impl<const M: usize, W: Fn(usize, usize) -> usize + Sync> Panels for PixelPanels<'_, M, W> {
    const POSITIONS: usize = M * M;
    const X_SHARED: bool = true;
    const ROWS: usize = 1;
    const TILE: usize = M;
    const TAPS: usize = M * M;

    fn grid(&self) -> TileGrid {
        grid(self.batch, &self.x.shape)
    }

    fn inputs(&self) -> usize {
        self.x.shape.channels
    }

    fn dy(&self) -> Images<'_> {
        self.dy
    }

    fn weight_at(&self, input: usize, output: usize) -> usize {
        (self.weight_at)(input, output)
    }

    #[inline(always)]
    fn prefetch_x(&self, segments: &[Segment], input: usize) {
        self.x.prefetch(segments, input, 1, (0, 1));
    }

    #[inline(always)]
    fn read_x<S: Simd>(&self, simd: S, segments: &[Segment], input: usize, panel: &mut [Row], _: usize) {
        self.x.read_tiles::<S, 1>(simd, segments, input, panel);
    }
}
