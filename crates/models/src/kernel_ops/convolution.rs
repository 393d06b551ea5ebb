//! Convolutions by the kernels.

use super::operation::{Argument, Operation, run};
use super::algorithm;
use burn::tensor::Tensor;
use kernels::{Algorithm, Conv3x3, Epilogue, Pointwise, TransposedConv};

/// 3x3 convolution with padding 1.
///
/// # Shapes
/// `x`: `[B, C_in, H, W]`; `weight`: `[C_out, C_in, 3, 3]`; result `[B, C_out, ceil(H / stride), ceil(W / stride)]`. `None` where there is no
/// kernel.
pub fn conv3x3(x: &Tensor<4>, weight: &Tensor<4>, stride: usize) -> Option<Tensor<4>> {
    let ([batch, inputs, height, width], [outputs, ..]) = (x.dims(), weight.dims());
    let algorithm = algorithm()?;
    if !matches!(stride, 1 | 2) {
        return None;
    }
    let conv = Conv3x3 { batch, inputs, outputs, height, width, stride, algorithm };
    Some(run(conv, [Argument::of(x)?, Argument::of(weight)?])?.0)
}

impl Operation<2> for Conv3x3 {
    type State = ();

    fn forward(&self, [x, weight]: [&[f32]; 2]) -> (Vec<f32>, Vec<usize>, ()) {
        let mut y = Vec::new();
        Conv3x3::forward(self, x, &self.pack(weight), Epilogue::default(), &mut y);
        (y, vec![self.batch, self.outputs, self.out_height(), self.out_width()], ())
    }

    fn backward(&self, [x, weight]: [&[f32]; 2], _: &(), dy: &[f32], wanted: [bool; 2]) -> [Option<Vec<f32>>; 2] {
        let dx = wanted[0].then(|| {
            let mut dx = Vec::new();
            self.data_gradient(dy, weight, &mut dx);
            dx
        });
        [dx, wanted[1].then(|| self.weight_gradient(x, dy))]
    }
}

/// Transposed convolution whose kernel is its stride.
///
/// # Shapes
/// `x`: `[B, C_in, H, W]`; `weight`: `[C_in, C_out, stride, stride]`; result `[B, C_out, H * stride, W * stride]`. `None` where there is no
/// kernel.
pub fn conv_transpose(x: &Tensor<4>, weight: &Tensor<4>, stride: usize) -> Option<Tensor<4>> {
    let ([batch, inputs, height, width], [_, outputs, ..]) = (x.dims(), weight.dims());
    algorithm()?;
    if !TransposedConv::STRIDES.contains(&stride) {
        return None;
    }
    let conv = TransposedConv { batch, inputs, outputs, height, width, stride };
    Some(run(conv, [Argument::of(x)?, Argument::of(weight)?])?.0)
}

impl Operation<2> for TransposedConv {
    type State = ();

    fn forward(&self, [x, weight]: [&[f32]; 2]) -> (Vec<f32>, Vec<usize>, ()) {
        let mut y = Vec::new();
        TransposedConv::forward(self, x, &self.pack(weight), Epilogue::default(), &mut y);
        (y, vec![self.batch, self.outputs, self.height * self.stride, self.width * self.stride], ())
    }

    fn backward(&self, [x, weight]: [&[f32]; 2], _: &(), dy: &[f32], wanted: [bool; 2]) -> [Option<Vec<f32>>; 2] {
        let dx = wanted[0].then(|| {
            let mut dx = Vec::new();
            self.data_gradient(dy, weight, &mut dx);
            dx
        });
        [dx, wanted[1].then(|| self.weight_gradient(x, dy))]
    }
}

/// 1x1 convolution with bias.
///
/// # Shapes
/// `x`: `[B, C_in, H, W]`; `weight`: `[C_out, C_in, 1, 1]`; `bias`: `[C_out]`; result `[B, C_out, H, W]`. `None` where there is no kernel.
pub fn pointwise(x: &Tensor<4>, weight: &Tensor<4>, bias: &Tensor<1>) -> Option<Tensor<4>> {
    let ([batch, inputs, height, width], [outputs, ..]) = (x.dims(), weight.dims());
    algorithm()?;
    let conv = WithBias { conv: Pointwise { batch, inputs, outputs, pixels: height * width }, size: [height, width] };
    Some(run(conv, [Argument::of(x)?, Argument::of(weight)?, Argument::of(bias)?])?.0)
}

#[derive(Clone, Debug)]
struct WithBias {
    conv: Pointwise,
    size: [usize; 2],
}

impl Operation<3> for WithBias {
    type State = ();

    fn forward(&self, [x, weight, bias]: [&[f32]; 3]) -> (Vec<f32>, Vec<usize>, ()) {
        let mut y = Vec::new();
        self.conv.forward(x, &self.conv.pack(weight), Epilogue { bias: Some(bias), relu: false }, &mut y);
        (y, vec![self.conv.batch, self.conv.outputs, self.size[0], self.size[1]], ())
    }

    fn backward(&self, [x, weight, _]: [&[f32]; 3], _: &(), dy: &[f32], wanted: [bool; 3]) -> [Option<Vec<f32>>; 3] {
        let dx = wanted[0].then(|| {
            let mut dx = Vec::new();
            self.conv.data_gradient(dy, weight, &mut dx);
            dx
        });
        [dx, wanted[1].then(|| self.conv.weight_gradient(x, dy)), wanted[2].then(|| self.conv.bias_gradient(dy))]
    }
}
