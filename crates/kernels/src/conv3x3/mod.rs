//! 3x3 convolution with padding 1 and no bias, as the backbone's blocks have it.

mod direct;
mod gradient_panels;
mod strided_gradient;
mod winograd;
mod winograd_product;

use crate::epilogue::Epilogue;
use crate::images::ImageShape;
use crate::output::{Shared, fill};
use crate::scheme::{PackedWeights, run};
use crate::weight_gradient::weight_gradient;
use direct::Direct;
use gradient_panels::{DirectPanels, Factors, WinogradPanels};
use std::marker::PhantomData;
use strided_gradient::StridedGradient;
use winograd::{F2, F4};
use winograd_product::WinogradProduct;

/// How a convolution of stride 1 is computed. One of stride 2 is always computed directly.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Algorithm {
    /// Winograd's F(2x2, 3x3).
    #[default]
    WinogradF2,
    /// Winograd's F(4x4, 3x3): faster, a digit less exact.
    WinogradF4,
    /// Nine products a pixel.
    Direct,
}

/// A convolution of images `[batch, inputs, height, width]` with weights `[outputs, inputs, 3, 3]` to images
/// `[batch, outputs, ceil(height / stride), ceil(width / stride)]`, with a border of zeros one pixel wide.
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
    /// For stride 1.
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

    /// The weights `[outputs, inputs, 3, 3]` in the form that [`Conv3x3::forward`] reads; it may be kept.
    pub fn pack(&self, weight: &[f32]) -> PackedWeights {
        self.check_weight(weight);
        let kernel = |o: usize, i: usize| taps(&weight[(o * self.inputs + i) * 9..]);
        match (self.stride, self.algorithm) {
            (1, Algorithm::WinogradF2) => winograd_product::pack::<F2, 2, 4>(self.inputs, self.outputs, kernel),
            (1, Algorithm::WinogradF4) => winograd_product::pack::<F4, 4, 6>(self.inputs, self.outputs, kernel),
            _ => direct::pack(self.inputs, self.outputs, kernel),
        }
    }

    /// `y`, overwritten, whatever it held.
    ///
    /// # Shapes
    /// `x`: `[batch, inputs, height, width]`; `y`: `[batch, outputs, out_height, out_width]`.
    pub fn forward(&self, x: &[f32], weights: &PackedWeights, epilogue: Epilogue<'_>, y: &mut Vec<f32>) {
        assert_eq!(x.len(), self.x_len(), "elements of x of {self:?}");
        assert!(epilogue.bias.is_none_or(|b| b.len() == self.outputs), "one bias an output of {self:?}");
        // SAFETY: the tiles of each scheme cover all pixels of all outputs.
        unsafe {
            fill(y, self.y_len(), |y| {
                let y = Shared::new(y);
                match (self.stride, self.algorithm) {
                    (1, Algorithm::WinogradF2) => run(&WinogradProduct::<F2, 2, 4>::new(self, x, y, epilogue), weights),
                    (1, Algorithm::WinogradF4) => run(&WinogradProduct::<F4, 4, 6>::new(self, x, y, epilogue), weights),
                    (1, Algorithm::Direct) => run(&Direct::<1>::new(self, x, y, epilogue), weights),
                    _ => run(&Direct::<2>::new(self, x, y, epilogue), weights),
                }
            });
        }
    }

    /// Gradient by `x`; `dx` is overwritten, whatever it held.
    ///
    /// # Shapes
    /// `dy`: `[batch, outputs, out_height, out_width]`; `weight`: `[outputs, inputs, 3, 3]`; `dx`: `[batch, inputs, height, width]`.
    pub fn data_gradient(&self, dy: &[f32], weight: &[f32], dx: &mut Vec<f32>) {
        assert_eq!(dy.len(), self.y_len(), "elements of dy of {self:?}");
        self.check_weight(weight);
        if self.stride == 1 {
            // The convolution of dy with the kernels turned round, inputs and outputs exchanged.
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
                fill(dx, self.x_len(), |dx| run(&StridedGradient::new(self, dy, Shared::new(dx)), &weights));
            }
        }
    }

    /// Gradient by the weights, `[outputs, inputs, 3, 3]`.
    ///
    /// # Shapes
    /// `x`: `[batch, inputs, height, width]`; `dy`: `[batch, outputs, out_height, out_width]`.
    pub fn weight_gradient(&self, x: &[f32], dy: &[f32]) -> Vec<f32> {
        assert_eq!(x.len(), self.x_len(), "elements of x of {self:?}");
        assert_eq!(dy.len(), self.y_len(), "elements of dy of {self:?}");
        let x_shape = ImageShape { channels: self.inputs, height: self.height, width: self.width };
        let dy_shape = ImageShape { channels: self.outputs, height: self.out_height(), width: self.out_width() };
        let factors = Factors { batch: self.batch, x, x_shape, dy, dy_shape };
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
        assert!(matches!(self.stride, 1 | 2), "a stride of 1 or 2: {self:?}");
    }
}

fn taps(weight: &[f32]) -> [f32; 9] {
    let mut taps = [0.0; 9];
    taps.copy_from_slice(&weight[..9]);
    taps
}

#[cfg(test)]
mod tests;
