//! 3x3 convolution with padding 1 and without bias, as in the blocks of the 2D backbone.

mod direct;
mod gradient_panels;
mod pixel_gradient;
mod strided_gradient;
mod winograd;
mod winograd_product;

use crate::epilogue::Epilogue;
use crate::images::{ImageShape, Images, ImagesOut};
use crate::output::{Shared, fill};
use crate::scheme::{PackedWeights, run};
use crate::weight_gradient::weight_gradient;
use direct::Direct;
use gradient_panels::{DirectPanels, Factors, WinogradPanels};
use std::marker::PhantomData;
use strided_gradient::StridedGradient;
use winograd::{F2, F4};
use winograd_product::WinogradProduct;

/// Algorithm of a convolution of stride 1. Stride 2 is always computed directly.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Algorithm {
    /// Winograd's F(2x2, 3x3).
    #[default]
    WinogradF2,
    /// Winograd's F(4x4, 3x3): faster, rounding error about ten times larger.
    WinogradF4,
    /// Direct convolution: nine multiplications a pixel.
    Direct,
}

/// A convolution of images `[batch, inputs, height, width]` with weights `[outputs, inputs, 3, 3]` to images
/// `[batch, outputs, ceil(height / stride), ceil(width / stride)]`, zero padding of one pixel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Conv3x3 {
    /// Images.
    pub batch: usize,
    /// Channels of `x`.
    pub inputs: usize,
    /// Channels of `y`.
    pub outputs: usize,
    /// Rows of `x`.
    pub height: usize,
    /// Columns of `x`.
    pub width: usize,
    /// 1 or 2.
    pub stride: usize,
    /// Algorithm for stride 1.
    pub algorithm: Algorithm,
}

impl Conv3x3 {
    /// Rows of `y`.
    pub fn out_height(&self) -> usize {
        self.height.div_ceil(self.stride)
    }

    /// Columns of `y`.
    pub fn out_width(&self) -> usize {
        self.width.div_ceil(self.stride)
    }

    fn x_shape(&self) -> ImageShape {
        ImageShape { channels: self.inputs, height: self.height, width: self.width }
    }

    fn y_shape(&self) -> ImageShape {
        ImageShape { channels: self.outputs, height: self.out_height(), width: self.out_width() }
    }

    /// Elements of `x`.
    pub fn x_len(&self) -> usize {
        self.batch * self.inputs * self.height * self.width
    }

    /// Elements of `y`.
    pub fn y_len(&self) -> usize {
        self.batch * self.outputs * self.out_height() * self.out_width()
    }

    /// Elements of the weights.
    pub fn weight_len(&self) -> usize {
        self.outputs * self.inputs * 9
    }

    /// The weights `[outputs, inputs, 3, 3]` packed for [`Conv3x3::forward`]. The result may be reused.
    pub fn pack(&self, weight: &[f32]) -> PackedWeights {
        self.check_weight(weight);
        let kernel = |o: usize, i: usize| taps(&weight[(o * self.inputs + i) * 9..]);
        match (self.stride, self.algorithm) {
            (1, Algorithm::WinogradF2) => winograd_product::pack::<F2, 2, 4>(self.inputs, self.outputs, kernel),
            (1, Algorithm::WinogradF4) => winograd_product::pack::<F4, 4, 6>(self.inputs, self.outputs, kernel),
            _ => direct::pack(self.inputs, self.outputs, kernel),
        }
    }

    /// Computes `y`, which is overwritten.
    ///
    /// # Shapes
    /// `x`: `[batch, inputs, height, width]`; `y`: `[batch, outputs, out_height, out_width]`.
    pub fn forward(&self, x: &[f32], weights: &PackedWeights, epilogue: Epilogue<'_>, y: &mut Vec<f32>) {
        assert_eq!(x.len(), self.x_len(), "elements of x of {self:?}");
        assert!(epilogue.bias.is_none_or(|b| b.len() == self.outputs), "biases of {self:?}");
        // SAFETY: the tiles of each scheme cover all pixels of all outputs.
        unsafe {
            fill(y, self.y_len(), |y| {
                let x = Images { values: x, shape: self.x_shape() };
                let y = ImagesOut { values: Shared::new(y), shape: self.y_shape(), epilogue };
                match (self.stride, self.algorithm) {
                    (1, Algorithm::WinogradF2) => run(&WinogradProduct::<F2, 2, 4>::new(self.batch, x, y), weights),
                    (1, Algorithm::WinogradF4) => run(&WinogradProduct::<F4, 4, 6>::new(self.batch, x, y), weights),
                    (1, Algorithm::Direct) => run(&Direct::<1> { batch: self.batch, x, y }, weights),
                    _ => run(&Direct::<2> { batch: self.batch, x, y }, weights),
                }
            });
        }
    }

    /// Gradient with respect to `x`; `dx` is overwritten.
    ///
    /// # Shapes
    /// `dy`: `[batch, outputs, out_height, out_width]`; `weight`: `[outputs, inputs, 3, 3]`; `dx`: `[batch, inputs,
    /// height, width]`.
    pub fn data_gradient(&self, dy: &[f32], weight: &[f32], dx: &mut Vec<f32>) {
        assert_eq!(dy.len(), self.y_len(), "elements of dy of {self:?}");
        self.check_weight(weight);
        if self.stride == 1 {
            // The convolution of dy with the kernels rotated by 180 degrees, inputs and outputs exchanged.
            let turned = Conv3x3 { inputs: self.outputs, outputs: self.inputs, ..*self };
            let kernel = |o: usize, i: usize| {
                let mut taps = taps(&weight[(i * self.inputs + o) * 9..]);
                taps.reverse();
                taps
            };
            let weights = match self.algorithm {
                Algorithm::WinogradF2 => winograd_product::pack::<F2, 2, 4>(turned.inputs, turned.outputs, kernel),
                Algorithm::WinogradF4 => winograd_product::pack::<F4, 4, 6>(turned.inputs, turned.outputs, kernel),
                Algorithm::Direct => direct::pack(turned.inputs, turned.outputs, kernel),
            };
            turned.forward(dy, &weights, Epilogue::default(), dx);
        } else {
            let weights = strided_gradient::pack(self, weight);
            // SAFETY: the four pixels of each tile cover the image.
            unsafe {
                fill(dx, self.x_len(), |dx| {
                    let dy = Images { values: dy, shape: self.y_shape() };
                    let epilogue = Epilogue::default();
                    let dx = ImagesOut { values: Shared::new(dx), shape: self.x_shape(), epilogue };
                    run(&StridedGradient { batch: self.batch, dy, dx }, &weights);
                });
            }
        }
    }

    /// Gradient with respect to `x` at some pixels, for stride 2; `dx` is overwritten.
    ///
    /// # Shapes
    /// `dy`: `[batch, outputs, out_height, out_width]`; `weight`: `[outputs, inputs, 3, 3]`; `cells`: P indices into
    /// `[batch, height, width]`; `dx`: `[P, inputs]`.
    pub fn data_gradient_at(&self, dy: &[f32], weight: &[f32], cells: &[u32], dx: &mut Vec<f32>) {
        assert_eq!(dy.len(), self.y_len(), "elements of dy of {self:?}");
        self.check_weight(weight);
        assert_eq!(self.stride, 2, "the stride must be 2: {self:?}");
        let pixels = self.batch * self.height * self.width;
        assert!(cells.iter().all(|&cell| (cell as usize) < pixels), "cells of {self:?}");
        // SAFETY: each cell is at one place of its tile, and is written with all its channels.
        unsafe {
            fill(dx, cells.len() * self.inputs, |dx| {
                let dy = Images { values: dy, shape: self.y_shape() };
                for (scheme, weights) in pixel_gradient::by_place(self, dy, cells, Shared::new(dx), weight) {
                    run(&scheme, &weights);
                }
            });
        }
    }

    /// Gradient with respect to the weights, `[outputs, inputs, 3, 3]`.
    ///
    /// # Shapes
    /// `x`: `[batch, inputs, height, width]`; `dy`: `[batch, outputs, out_height, out_width]`.
    pub fn weight_gradient(&self, x: &[f32], dy: &[f32]) -> Vec<f32> {
        assert_eq!(x.len(), self.x_len(), "elements of x of {self:?}");
        assert_eq!(dy.len(), self.y_len(), "elements of dy of {self:?}");
        let (x, dy) = (Images { values: x, shape: self.x_shape() }, Images { values: dy, shape: self.y_shape() });
        let factors = Factors { batch: self.batch, x, dy };
        match (self.stride, self.algorithm) {
            (1, Algorithm::WinogradF2) => {
                weight_gradient(&WinogradPanels::<F2, 2, 4> { factors, transforms: PhantomData })
            }
            (1, Algorithm::WinogradF4) => {
                weight_gradient(&WinogradPanels::<F4, 4, 6> { factors, transforms: PhantomData })
            }
            (1, Algorithm::Direct) => weight_gradient(&DirectPanels::<1>(factors)),
            _ => weight_gradient(&DirectPanels::<2>(factors)),
        }
    }

    fn check_weight(&self, weight: &[f32]) {
        assert_eq!(weight.len(), self.weight_len(), "elements of the weights of {self:?}");
        assert!(matches!(self.stride, 1 | 2), "the stride must be 1 or 2: {self:?}");
    }
}

fn taps(weight: &[f32]) -> [f32; 9] {
    let mut taps = [0.0; 9];
    taps.copy_from_slice(&weight[..9]);
    taps
}

#[cfg(test)]
mod tests;
