//! 1x1 convolution with an optional bias: the detection head.

use crate::epilogue::Epilogue;
use crate::images::ImageShape;
use crate::output::{Shared, fill};
use crate::scheme::{PackedWeights, run};
use crate::upsampling::{Expand, PixelPanels, pack_expand};
use crate::weight_gradient::weight_gradient;
use rayon::prelude::*;

/// A convolution of images `[batch, inputs, pixels]` with weights `[outputs, inputs]` to images `[batch, outputs, pixels]`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Pointwise {
    /// Images.
    pub batch: usize,
    /// Channels of `x`.
    pub inputs: usize,
    /// Channels of `y`.
    pub outputs: usize,
    /// Pixels of an image: rows times columns.
    pub pixels: usize,
}

impl Pointwise {
    fn shape(&self, channels: usize) -> ImageShape {
        ImageShape { channels, height: 1, width: self.pixels }
    }

    /// The weights `[outputs, inputs]` in the form that [`Pointwise::forward`] reads; it may be kept.
    pub fn pack(&self, weight: &[f32]) -> PackedWeights {
        assert_eq!(weight.len(), self.outputs * self.inputs, "elements of the weights of {self:?}");
        pack_expand::<1>(self.inputs, self.outputs, |o, i, _| weight[o * self.inputs + i])
    }

    /// `y`, overwritten, whatever it held.
    ///
    /// # Shapes
    /// `x`: `[batch, inputs, pixels]`; `y`: `[batch, outputs, pixels]`.
    pub fn forward(&self, x: &[f32], weights: &PackedWeights, epilogue: Epilogue<'_>, y: &mut Vec<f32>) {
        assert_eq!(x.len(), self.batch * self.inputs * self.pixels, "elements of x of {self:?}");
        assert!(epilogue.bias.is_none_or(|b| b.len() == self.outputs), "one bias an output of {self:?}");
        let (batch, x_shape, y_shape) = (self.batch, self.shape(self.inputs), self.shape(self.outputs));
        // SAFETY: every pixel is in one of the blocks.
        unsafe {
            fill(y, batch * self.outputs * self.pixels, |y| {
                run(&Expand::<1> { batch, x, x_shape, y: Shared::new(y), y_shape, epilogue }, weights);
            });
        }
    }

    /// Gradient by `x`; `dx` is overwritten, whatever it held.
    ///
    /// # Shapes
    /// `dy`: `[batch, outputs, pixels]`; `weight`: `[outputs, inputs]`; `dx`: `[batch, inputs, pixels]`.
    pub fn data_gradient(&self, dy: &[f32], weight: &[f32], dx: &mut Vec<f32>) {
        assert_eq!(weight.len(), self.outputs * self.inputs, "elements of the weights of {self:?}");
        let transposed = Pointwise { inputs: self.outputs, outputs: self.inputs, ..*self };
        let weights = pack_expand::<1>(self.outputs, self.inputs, |i, o, _| weight[o * self.inputs + i]);
        transposed.forward(dy, &weights, Epilogue::default(), dx);
    }

    /// Gradient by the weights, `[outputs, inputs]`.
    ///
    /// # Shapes
    /// `x`: `[batch, inputs, pixels]`; `dy`: `[batch, outputs, pixels]`.
    pub fn weight_gradient(&self, x: &[f32], dy: &[f32]) -> Vec<f32> {
        assert_eq!(x.len(), self.batch * self.inputs * self.pixels, "elements of x of {self:?}");
        self.check_dy(dy);
        let (batch, x_shape, dy_shape) = (self.batch, self.shape(self.inputs), self.shape(self.outputs));
        let weight_at = |input, output| output * self.inputs + input;
        weight_gradient(&PixelPanels::<1, _> { batch, x, x_shape, dy, dy_shape, weight_at })
    }

    /// Gradient by the bias, `[outputs]`.
    ///
    /// # Shapes
    /// `dy`: `[batch, outputs, pixels]`.
    pub fn bias_gradient(&self, dy: &[f32]) -> Vec<f32> {
        self.check_dy(dy);
        let plane = |image: usize, output: usize| &dy[(image * self.outputs + output) * self.pixels..][..self.pixels];
        let sum =
            |output| (0..self.batch).map(|n| plane(n, output).iter().map(|&v| v as f64).sum::<f64>()).sum::<f64>();
        (0..self.outputs).into_par_iter().map(|output| sum(output) as f32).collect()
    }

    fn check_dy(&self, dy: &[f32]) {
        assert_eq!(dy.len(), self.batch * self.outputs * self.pixels, "elements of dy of {self:?}");
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reference::{assert_close, assert_same_for_threads, random};

    fn shapes() -> Vec<Pointwise> {
        let of = |[batch, inputs, outputs, pixels]: [usize; 4]| Pointwise { batch, inputs, outputs, pixels };
        [[1, 1, 1, 1], [2, 3, 5, 31], [1, 9, 2, 33], [3, 20, 17, 64], [1, 70, 150, 100], [1, 4, 4, 1000]].map(of).into()
    }

    fn all(conv: &Pointwise, x: &[f32], w: &[f32], b: &[f32], dy: &[f32]) -> [Vec<f32>; 4] {
        let (mut y, mut dx) = (Vec::new(), vec![3.0]);
        conv.forward(x, &conv.pack(w), Epilogue { bias: Some(b), relu: false }, &mut y);
        conv.data_gradient(dy, w, &mut dx);
        [y, dx, conv.weight_gradient(x, dy), conv.bias_gradient(dy)]
    }

    fn inputs(conv: &Pointwise) -> [Vec<f32>; 4] {
        let &Pointwise { batch, inputs, outputs, pixels } = conv;
        let lengths = [batch * inputs * pixels, inputs * outputs, outputs, batch * outputs * pixels];
        std::array::from_fn(|i| random(lengths[i], i as u64))
    }

    #[test]
    fn equals_the_definition() {
        for conv in shapes() {
            let Pointwise { batch, inputs: ci, outputs: co, pixels } = conv;
            let [x, w, b, dy] = inputs(&conv);
            let mut want = [vec![0.0; dy.len()], vec![0.0; x.len()], vec![0.0; w.len()], vec![0.0; co]];
            for n in 0..batch {
                for (o, p) in (0..co).flat_map(|o| (0..pixels).map(move |p| (o, p))) {
                    let yi = (n * co + o) * pixels + p;
                    want[0][yi] += b[o] as f64;
                    want[3][o] += dy[yi] as f64;
                    for i in 0..ci {
                        let (xi, wi) = ((n * ci + i) * pixels + p, o * ci + i);
                        want[0][yi] += x[xi] as f64 * w[wi] as f64;
                        want[1][xi] += dy[yi] as f64 * w[wi] as f64;
                        want[2][wi] += dy[yi] as f64 * x[xi] as f64;
                    }
                }
            }
            for (i, (got, want)) in all(&conv, &x, &w, &b, &dy).iter().zip(&want).enumerate() {
                assert_close(got, want, 2e-6, &format!("{i} of {conv:?}"));
            }
        }
    }

    #[test]
    fn the_number_of_threads_changes_no_bit() {
        let conv = Pointwise { batch: 2, inputs: 40, outputs: 19, pixels: 1500 };
        let [x, w, b, dy] = inputs(&conv);
        assert_same_for_threads(|| all(&conv, &x, &w, &b, &dy));
    }

    #[test]
    fn what_is_not_a_number_comes_out() {
        let conv = Pointwise { batch: 1, inputs: 3, outputs: 2, pixels: 40 };
        let [mut x, w, b, mut dy] = inputs(&conv);
        (x[40 + 7], dy[5]) = (f32::NAN, f32::NAN);
        let [y, dx, dw, db] = all(&conv, &x, &w, &b, &dy);
        let places = |v: &[f32]| (0..v.len()).filter(|&i| v[i].is_nan()).collect::<Vec<_>>();
        assert_eq!(places(&y), [7, 47]);
        assert_eq!(places(&dx), [5, 45, 85]);
        assert_eq!(places(&dw), [0, 1, 2, 4]);
        assert_eq!(places(&db), [0]);
    }
}
