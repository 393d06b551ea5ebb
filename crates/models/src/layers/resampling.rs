//! Changes of resolution with batch norm and ReLU.

use super::conv::values;
use super::precision::multiply;
use super::{BatchNorm, Init, Mode};
use crate::kernel_ops::{folded_transposed, transposed};
use crate::products;
use burn::module::{Module, Param};
use burn::tensor::Tensor;
use burn::tensor::module::{conv_transpose2d, conv2d};
use burn::tensor::ops::{ConvOptions, ConvTransposeOptions};

/// A change of resolution by a whole number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Resampling {
    /// Transposed convolution with kernel = stride.
    Up(usize),
    /// Convolution with kernel = stride.
    Down(usize),
}

impl Resampling {
    /// From a factor of the resolution; `None` if neither it nor its inverse is a whole number.
    pub fn of(factor: f32) -> Option<Self> {
        let whole = |v: f32| ((1.0..=64.0).contains(&v) && (v - v.round()).abs() < 1e-3).then_some(v.round() as usize);
        if factor >= 1.0 { whole(factor).map(Resampling::Up) } else { whole(1.0 / factor).map(Resampling::Down) }
    }
}

/// Transposed convolution or convolution, kernel = stride, no bias; batch normalisation, ReLU.
#[derive(Module, Debug)]
pub struct ResampleBnRelu {
    /// `[C_in, C_out, stride, stride]` of a transposed convolution, `[C_out, C_in, stride, stride]` of a convolution.
    pub weight: Param<Tensor<4>>,
    /// The batch norm after the convolution.
    pub norm: BatchNorm,
    stride: usize,
    down: bool,
}

impl ResampleBnRelu {
    /// A layer of the given channels; `name` keys its initial weights.
    pub fn new(name: &str, channels: [usize; 2], resampling: Resampling, norm: BatchNorm, init: &Init<'_>) -> Self {
        let [input, output] = channels;
        let (down, stride, shape) = match resampling {
            Resampling::Up(stride) => (false, stride, [input, output, stride, stride]),
            Resampling::Down(stride) => (true, stride, [output, input, stride, stride]),
        };
        ResampleBnRelu { weight: init.uniform(name, shape, shape[1] * stride * stride), norm, stride, down }
    }

    /// # Shapes
    /// `x`: `[B, C_in, H, W]`; result `[B, C_out, H * stride, W * stride]`, or divided by the stride.
    pub fn forward(&self, x: Tensor<4>, mode: Mode) -> Tensor<4> {
        let (weight, stride) = (self.weight.val(), self.stride);
        let by_products = products::are_used_on(&x.device());
        if self.down {
            let y = multiply(x, weight, |x, weight| {
                let options = ConvOptions::new([stride; 2], [0, 0], [1, 1], 1);
                if by_products { products::strided(x, weight) } else { conv2d(x, weight, None, options) }
            });
            return self.norm.forward_relu(y, None, mode);
        }
        let fold = || self.norm.folded(None, |n| n.fold_into_transposed(&values(&weight), stride));
        if mode == Mode::Eval
            && let Some(y) = folded_transposed(&x, stride, fold)
        {
            return y;
        }
        if by_products {
            return self.norm.forward_relu(multiply(x, weight, products::transposed), None, mode);
        }
        let y = transposed(&x, &weight, stride).unwrap_or_else(|| {
            let options = ConvTransposeOptions::new([stride; 2], [0, 0], [0, 0], [1, 1], 1);
            multiply(x, weight, |x, weight| conv_transpose2d(x, weight, None, options))
        });
        self.norm.forward_relu(y, None, mode)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn resampling_by_whole_numbers_and_their_inverses() {
        for (stride, want) in [
            (1.0, Some(Resampling::Up(1))),
            (4.0, Some(Resampling::Up(4))),
            (0.5, Some(Resampling::Down(2))),
            (1.0 / 3.0, Some(Resampling::Down(3))),
            (1.5, None),
            (0.4, None),
            (0.0, None),
            (-2.0, None),
            (f32::NAN, None),
            (f32::INFINITY, None),
        ] {
            assert_eq!(Resampling::of(stride), want, "{stride}");
        }
    }
}
