//! The heads of a detector: 1x1 convolutions of the same image with channels-last outputs.

use super::{Kernel, apply, input};
use burn::tensor::Tensor;
use kernels::PixelHeads;

impl Kernel<3> for PixelHeads {
    type State = ();

    fn forward(&self, [x, weight, bias]: [&[f32]; 3]) -> (Vec<f32>, ()) {
        let mut y = Vec::new();
        PixelHeads::forward(self, x, weight, bias, &mut y);
        (y, ())
    }

    fn backward(&self, [x, weight, _]: [&[f32]; 3], (): &(), dy: &[f32], _: [bool; 3]) -> [Option<Vec<f32>>; 3] {
        let found = PixelHeads::backward(self, x, weight, dy);
        [Some(found.x), Some(found.weight), Some(found.bias)]
    }

    fn shape(&self) -> Vec<usize> {
        vec![self.batch * self.pixels * self.outputs.iter().sum::<usize>()]
    }
}

/// Weight and bias of a 1x1 convolution.
type Head<'a> = (&'a Tensor<4>, &'a Tensor<1>);

/// Several 1x1 convolutions with bias of one image.
///
/// # Shapes
/// `x`: `[B, C, H, W]`; weights `[K, C, 1, 1]` and biases `[K]`; results `[B * H * W, K]`.
pub fn pixel_heads<const N: usize>(x: &Tensor<4>, heads: [Head<'_>; N]) -> Option<[Tensor<2>; N]> {
    let x_input = input(x)?;
    let [batch, inputs, height, width] = x.dims();
    let outputs = heads.map(|(weight, _)| weight.dims()[0]);
    let pixels = height * width;
    let weight = Tensor::cat(heads.map(|(weight, _)| weight.clone()).to_vec(), 0); // [sum of K, C, 1, 1]
    let bias = Tensor::cat(heads.map(|(_, bias)| bias.clone()).to_vec(), 0); // [sum of K]
    let kernel = PixelHeads { batch, inputs, pixels, outputs: outputs.to_vec() };
    let (all, ()): (Tensor<1>, ()) = apply(kernel, [Some(x_input), input(&weight), input(&bias)])?;
    let rows = batch * pixels;
    let mut first = 0;
    Some(outputs.map(|k| {
        let head = all.clone().narrow(0, first, rows * k);
        first += rows * k;
        head.reshape([rows, k]) // [B * H * W, K]
    }))
}
