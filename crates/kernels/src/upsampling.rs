//! Products of the channels of single pixels: one pixel becomes `M x M`, or `M x M` become one. With `M = 1` this is a 1x1 convolution, else a
//! transposed convolution whose kernel is its stride, and its gradients.

use crate::blocks::{Segment, TileGrid};
use crate::epilogue::Epilogue;
use crate::images::{ImageShape, Work, rounded, write_tiles};
use crate::line;
use crate::output::Shared;
use crate::scheme::{PackedWeights, Scheme};
use crate::tile::{PIXELS, Row};
use crate::weight_gradient::Panels;
use pulp::Simd;
use std::ops::Range;

/// From each pixel of `x` `M x M` pixels of `y`.
pub(crate) struct Expand<'a, const M: usize> {
    pub batch: usize,
    pub x: &'a [f32],
    pub x_shape: ImageShape,
    /// Nothing else may be writing here.
    pub y: Shared<'a>,
    pub y_shape: ImageShape,
    pub epilogue: Epilogue<'a>,
}

/// Weights of [`Expand`]; `weight(output, input, pixel)`.
pub(crate) fn pack_expand<const M: usize>(
    inputs: usize,
    outputs: usize,
    weight: impl Fn(usize, usize, usize) -> f32 + Sync,
) -> PackedWeights {
    PackedWeights::new(outputs, M * M * inputs, |output, put| {
        for pixel in 0..M * M {
            for input in 0..inputs {
                put(pixel * inputs + input, weight(output, input, pixel));
            }
        }
    })
}

fn grid(batch: usize, shape: &ImageShape) -> TileGrid {
    TileGrid { batch, rows: shape.height, columns: shape.width }
}

/// The pixels of a block in one channel.
#[inline(always)]
fn read_pixels(x: &[f32], shape: &ImageShape, segments: &[Segment], channel: usize, row: &mut Row, work: &mut Work) {
    for s in segments {
        if let Some(row) = shape.row(s.image, channel, s.row as isize) {
            line::read(x, row, s.column as isize, s.len, &mut work.line);
            let count = rounded(s);
            work.rows[0][s.at..s.at + count].copy_from_slice(&work.line[..count]);
        }
    }
    row.copy_from_slice(&work.rows[0][..PIXELS]);
}

impl<const M: usize> Scheme for Expand<'_, M> {
    fn grid(&self) -> TileGrid {
        grid(self.batch, &self.x_shape)
    }

    fn inputs(&self) -> usize {
        self.x_shape.channels
    }

    fn outputs(&self) -> usize {
        self.y_shape.channels
    }

    fn panel_rows(&self) -> usize {
        self.inputs()
    }

    fn products(&self) -> Vec<Range<usize>> {
        vec![0..self.inputs(); M * M]
    }

    #[inline(always)]
    fn read<S: Simd>(&self, _: S, segments: &[Segment], channel: usize, panel: &mut [Row], work: &mut Work) {
        read_pixels(self.x, &self.x_shape, segments, channel, &mut panel[channel], work);
    }

    #[inline(always)]
    fn write<'r, S: Simd>(
        &self,
        _: S,
        segments: &[Segment],
        channel: usize,
        products: impl Fn(usize) -> &'r Row,
        work: &mut Work,
    ) {
        for (pixel, row) in work.rows[..M * M].iter_mut().enumerate() {
            row[..PIXELS].copy_from_slice(products(pixel));
            self.epilogue.apply(channel, &mut row[..PIXELS]);
        }
        // SAFETY: no pixel of `x` is in two blocks, and one thread works on a block.
        unsafe { write_tiles::<M>(&self.y, &self.y_shape, channel, segments, work) };
    }
}

/// From `M x M` pixels of `dy` one pixel of `dx`.
pub(crate) struct Gather<'a, const M: usize> {
    pub batch: usize,
    pub dy: &'a [f32],
    pub dy_shape: ImageShape,
    /// Nothing else may be writing here.
    pub dx: Shared<'a>,
    pub dx_shape: ImageShape,
}

/// Weights of [`Gather`]; `weight(channel of dx, channel of dy, pixel)`.
pub(crate) fn pack_gather<const M: usize>(
    dx_channels: usize,
    dy_channels: usize,
    weight: impl Fn(usize, usize, usize) -> f32 + Sync,
) -> PackedWeights {
    PackedWeights::new(dx_channels, dy_channels * M * M, |to, put| {
        for from in 0..dy_channels {
            for pixel in 0..M * M {
                put(from * M * M + pixel, weight(to, from, pixel));
            }
        }
    })
}

impl<const M: usize> Scheme for Gather<'_, M> {
    fn grid(&self) -> TileGrid {
        grid(self.batch, &self.dx_shape)
    }

    fn inputs(&self) -> usize {
        self.dy_shape.channels
    }

    fn outputs(&self) -> usize {
        self.dx_shape.channels
    }

    fn panel_rows(&self) -> usize {
        self.inputs() * M * M
    }

    fn products(&self) -> Vec<Range<usize>> {
        std::iter::once(0..self.panel_rows()).collect()
    }

    #[inline(always)]
    fn read<S: Simd>(&self, _: S, segments: &[Segment], channel: usize, panel: &mut [Row], work: &mut Work) {
        for s in segments {
            let count = rounded(s);
            for i in 0..M {
                let Some(row) = self.dy_shape.row(s.image, channel, (s.row * M + i) as isize) else { continue };
                line::read(self.dy, row, (s.column * M) as isize, s.len * M, &mut work.line);
                let mut rows = work.rows[i * M..].iter_mut();
                let to: [&mut [f32]; M] =
                    std::array::from_fn(|_| rows.next().map_or(&mut [][..], |r| &mut r[s.at..s.at + count]));
                for (t, pixel) in work.line.as_chunks::<M>().0[..count].iter().enumerate() {
                    for j in 0..M {
                        to[j][t] = pixel[j];
                    }
                }
            }
        }
        for (to, from) in panel[channel * M * M..].iter_mut().zip(&work.rows[..M * M]) {
            to.copy_from_slice(&from[..PIXELS]);
        }
    }

    #[inline(always)]
    fn write<'r, S: Simd>(
        &self,
        _: S,
        segments: &[Segment],
        channel: usize,
        products: impl Fn(usize) -> &'r Row,
        work: &mut Work,
    ) {
        work.rows[0][..PIXELS].copy_from_slice(products(0));
        // SAFETY: no pixel of `dx` is in two blocks, and one thread works on a block.
        unsafe { write_tiles::<1>(&self.dx, &self.dx_shape, channel, segments, work) };
    }
}

/// The factors of the gradient by the weights of [`Expand`].
pub(crate) struct PixelPanels<'a, const M: usize, W> {
    pub batch: usize,
    pub x: &'a [f32],
    pub x_shape: ImageShape,
    pub dy: &'a [f32],
    pub dy_shape: ImageShape,
    /// Place of the first weight of (input, output).
    pub weight_at: W,
}

impl<const M: usize, W: Fn(usize, usize) -> usize + Sync> Panels for PixelPanels<'_, M, W> {
    const POSITIONS: usize = M * M;
    const X_SHARED: bool = true;
    const ROWS: usize = 1;
    const TILE: usize = M;
    const TAPS: usize = M * M;

    fn grid(&self) -> TileGrid {
        grid(self.batch, &self.x_shape)
    }

    fn inputs(&self) -> usize {
        self.x_shape.channels
    }

    fn dy(&self) -> (&[f32], &ImageShape) {
        (self.dy, &self.dy_shape)
    }

    fn weight_at(&self, input: usize, output: usize) -> usize {
        (self.weight_at)(input, output)
    }

    #[inline(always)]
    fn read_x<S: Simd>(&self, _: S, segments: &[Segment], input: usize, panel: &mut [Row], _: usize, work: &mut Work) {
        read_pixels(self.x, &self.x_shape, segments, input, &mut panel[0], work);
    }
}
