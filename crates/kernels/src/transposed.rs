//! Transposed convolution with kernel size equal to stride and without bias: the upsampling of the 2D backbone.

use crate::epilogue::Epilogue;
use crate::images::{ImageShape, Images, ImagesOut};
use crate::output::{Shared, fill};
use crate::scheme::{PackedWeights, run};
use crate::upsampling::{Expand, Gather, PixelPanels, pack_expand, pack_gather};
use crate::weight_gradient::weight_gradient;

/// A transposed convolution of images `[batch, inputs, height, width]` with weights `[inputs, outputs, stride, stride]`
/// to images `[batch, outputs, height * stride, width * stride]`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TransposedConv {
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
    /// Upsampling factor; one of [`TransposedConv::STRIDES`].
    pub stride: usize,
}

/// Calls `$work` with `M` = the stride.
macro_rules! with_stride {
    ($conv:expr, $M:ident => $work:expr) => {
        match $conv.stride {
            1 => {
                const $M: usize = 1;
                $work
            }
            2 => {
                const $M: usize = 2;
                $work
            }
            4 => {
                const $M: usize = 4;
                $work
            }
            _ => panic!("the stride must be 1, 2 or 4: {:?}", $conv),
        }
    };
}

impl TransposedConv {
    /// Supported strides.
    pub const STRIDES: [usize; 3] = [1, 2, 4];

    fn x_shape(&self) -> ImageShape {
        ImageShape { channels: self.inputs, height: self.height, width: self.width }
    }

    fn y_shape(&self) -> ImageShape {
        let (height, width) = (self.height * self.stride, self.width * self.stride);
        ImageShape { channels: self.outputs, height, width }
    }

    /// Elements of `x`.
    pub fn x_len(&self) -> usize {
        self.batch * self.inputs * self.height * self.width
    }

    /// Elements of `y`.
    pub fn y_len(&self) -> usize {
        self.batch * self.outputs * self.height * self.width * self.stride * self.stride
    }

    /// Elements of the weights.
    pub fn weight_len(&self) -> usize {
        self.inputs * self.outputs * self.stride * self.stride
    }

    fn weight_at(&self, input: usize, output: usize) -> usize {
        (input * self.outputs + output) * self.stride * self.stride
    }

    /// The weights `[inputs, outputs, stride, stride]` packed for [`TransposedConv::forward`]. The result may be
    /// reused.
    pub fn pack(&self, weight: &[f32]) -> PackedWeights {
        assert_eq!(weight.len(), self.weight_len(), "elements of the weights of {self:?}");
        let weight = |output, input, pixel| weight[self.weight_at(input, output) + pixel];
        with_stride!(self, M => pack_expand::<M>(self.inputs, self.outputs, weight))
    }

    /// Computes `y`, which is overwritten.
    ///
    /// # Shapes
    /// `x`: `[batch, inputs, height, width]`; `y`: `[batch, outputs, height * stride, width * stride]`.
    pub fn forward(&self, x: &[f32], weights: &PackedWeights, epilogue: Epilogue<'_>, y: &mut Vec<f32>) {
        assert_eq!(x.len(), self.x_len(), "elements of x of {self:?}");
        assert!(epilogue.bias.is_none_or(|b| b.len() == self.outputs), "biases of {self:?}");
        let (batch, x) = (self.batch, Images { values: x, shape: self.x_shape() });
        // SAFETY: every pixel of x is in one of the blocks, and their output pixels cover y.
        unsafe {
            fill(y, self.y_len(), |y| {
                let y = ImagesOut { values: Shared::new(y), shape: self.y_shape(), epilogue };
                with_stride!(self, M => run(&Expand::<M> { batch, x, y }, weights));
            });
        }
    }

    /// Gradient with respect to `x`; `dx` is overwritten.
    ///
    /// # Shapes
    /// `dy`: `[batch, outputs, height * stride, width * stride]`; `dx`: `[batch, inputs, height, width]`.
    pub fn data_gradient(&self, dy: &[f32], weight: &[f32], dx: &mut Vec<f32>) {
        assert_eq!(dy.len(), self.y_len(), "elements of dy of {self:?}");
        assert_eq!(weight.len(), self.weight_len(), "elements of the weights of {self:?}");
        let weight = |input, output, pixel| weight[self.weight_at(input, output) + pixel];
        let (batch, dy) = (self.batch, Images { values: dy, shape: self.y_shape() });
        // SAFETY: every pixel of dx is in one of the blocks.
        unsafe {
            fill(dx, self.x_len(), |dx| {
                let epilogue = Epilogue::default();
                let dx = ImagesOut { values: Shared::new(dx), shape: self.x_shape(), epilogue };
                with_stride!(self, M => {
                    let weights = pack_gather::<M>(self.inputs, self.outputs, weight);
                    run(&Gather::<M> { batch, dy, dx }, &weights);
                });
            });
        }
    }

    /// Gradient with respect to the weights, `[inputs, outputs, stride, stride]`.
    ///
    /// # Shapes
    /// `x`: `[batch, inputs, height, width]`; `dy`: `[batch, outputs, height * stride, width * stride]`.
    pub fn weight_gradient(&self, x: &[f32], dy: &[f32]) -> Vec<f32> {
        assert_eq!(x.len(), self.x_len(), "elements of x of {self:?}");
        assert_eq!(dy.len(), self.y_len(), "elements of dy of {self:?}");
        let (batch, x) = (self.batch, Images { values: x, shape: self.x_shape() });
        let dy = Images { values: dy, shape: self.y_shape() };
        let weight_at = |input, output| self.weight_at(input, output);
        with_stride!(self, M => weight_gradient(&PixelPanels::<M, _> { batch, x, dy, weight_at }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reference::{assert_close, assert_same_for_threads, random};

    fn all(conv: &TransposedConv, x: &[f32], w: &[f32], dy: &[f32]) -> [Vec<f32>; 3] {
        let (mut y, mut dx) = (Vec::new(), vec![3.0]);
        conv.forward(x, &conv.pack(w), Epilogue::default(), &mut y);
        conv.data_gradient(dy, w, &mut dx);
        [y, dx, conv.weight_gradient(x, dy)]
    }

    fn inputs(conv: &TransposedConv) -> [Vec<f32>; 3] {
        [random(conv.x_len(), 1), random(conv.weight_len(), 2), random(conv.y_len(), 3)]
    }

    #[test]
    fn equals_the_definition() {
        for [batch, inputs_, outputs, height, width] in
            [[1, 1, 1, 1, 1], [2, 3, 5, 3, 4], [1, 9, 2, 2, 33], [1, 20, 17, 9, 7], [1, 4, 130, 5, 27]]
        {
            for stride in TransposedConv::STRIDES {
                let conv = TransposedConv { batch, inputs: inputs_, outputs, height, width, stride };
                let [x, w, dy] = inputs(&conv);
                let mut want = [vec![0.0; dy.len()], vec![0.0; x.len()], vec![0.0; w.len()]];
                for (xi, yi, wi) in pairs(&conv) {
                    want[0][yi] += x[xi] as f64 * w[wi] as f64;
                    want[1][xi] += dy[yi] as f64 * w[wi] as f64;
                    want[2][wi] += dy[yi] as f64 * x[xi] as f64;
                }
                for (i, (got, want)) in all(&conv, &x, &w, &dy).iter().zip(&want).enumerate() {
                    assert_close(got, want, 2e-6, &format!("{i} of {conv:?}"));
                }
            }
        }
    }

    /// Indices of x, y and weight in each product of the definition.
    fn pairs(conv: &TransposedConv) -> Vec<(usize, usize, usize)> {
        let (s, shape) = (conv.stride, conv.y_shape());
        let mut all = Vec::new();
        for xi in 0..conv.x_len() {
            let (plane, pixel) = (xi / (conv.height * conv.width), xi % (conv.height * conv.width));
            let (n, i) = (plane / conv.inputs, plane % conv.inputs);
            for o in 0..conv.outputs {
                for k in 0..s * s {
                    let (row, column) = (pixel / conv.width * s + k / s, pixel % conv.width * s + k % s);
                    let yi = ((n * conv.outputs + o) * shape.height + row) * shape.width + column;
                    all.push((xi, yi, (i * conv.outputs + o) * s * s + k));
                }
            }
        }
        all
    }

    #[test]
    fn the_result_is_bit_equal_for_any_number_of_threads() {
        for stride in TransposedConv::STRIDES {
            let conv = TransposedConv { batch: 2, inputs: 10, outputs: 7, height: 30, width: 41, stride };
            let [x, w, dy] = inputs(&conv);
            assert_same_for_threads(|| all(&conv, &x, &w, &dy));
        }
    }

    #[test]
    fn nan_propagates() {
        for stride in TransposedConv::STRIDES {
            let conv = TransposedConv { batch: 1, inputs: 2, outputs: 3, height: 3, width: 35, stride };
            let [mut x, w, mut dy] = inputs(&conv);
            (x[40], dy[40]) = (f32::NAN, f32::NAN);
            let [y, dx, dw] = all(&conv, &x, &w, &dy);
            let count = |v: &[f32]| v.iter().filter(|v| v.is_nan()).count();
            assert_eq!((count(&y), count(&dx)), (3 * stride * stride, 2));
            assert!(count(&dw) > 0);
        }
    }
}
