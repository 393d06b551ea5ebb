//! Convolutions with the kernels' gradients for training, and with folded batch norm for inference.

use super::{Input, Kernel, Kernels, apply, chosen_kernels, input};
use burn::tensor::Tensor;
use kernels::{Algorithm, Conv3x3, Epilogue, Folded, TransposedConv};

fn algorithm() -> Algorithm {
    if chosen_kernels() == Kernels::AutoF4 { Algorithm::WinogradF4 } else { Algorithm::WinogradF2 }
}

pub(super) fn conv(x: [usize; 4], outputs: usize, stride: usize) -> Option<Conv3x3> {
    let [batch, inputs, height, width] = x;
    let algorithm = algorithm();
    matches!(stride, 1 | 2).then_some(Conv3x3 { batch, inputs, outputs, height, width, stride, algorithm })
}

impl Kernel<2> for Conv3x3 {
    type State = ();

    fn forward(&self, [x, weight]: [&[f32]; 2]) -> (Vec<f32>, ()) {
        let mut y = Vec::new();
        Conv3x3::forward(self, x, &self.pack(weight), Epilogue::default(), &mut y);
        (y, ())
    }

    fn backward(&self, [x, weight]: [&[f32]; 2], (): &(), dy: &[f32], wanted: [bool; 2]) -> [Option<Vec<f32>>; 2] {
        let dx = wanted[0].then(|| {
            let mut dx = Vec::new();
            self.data_gradient(dy, weight, &mut dx);
            dx
        });
        [dx, wanted[1].then(|| self.weight_gradient(x, dy))]
    }

    fn shape(&self) -> Vec<usize> {
        vec![self.batch, self.outputs, self.out_height(), self.out_width()]
    }
}

/// 3x3 convolution with padding 1 and stride 1 or 2.
///
/// # Shapes
/// `x`: `[B, C_in, H, W]`; `weight`: `[C_out, C_in, 3, 3]`; result `[B, C_out, H / stride, W / stride]`.
pub fn conv3x3(x: &Tensor<4>, weight: &Tensor<4>, stride: usize) -> Option<Tensor<4>> {
    let conv = conv(x.dims(), weight.dims()[0], stride)?;
    apply(conv, [input(x), input(weight)]).map(|(y, ())| y)
}

/// A kernel whose weights include the folded batch norm, followed by a ReLU.
#[derive(Clone, Debug)]
struct Inference<C> {
    conv: C,
    folded: Folded,
}

impl Kernel<1> for Inference<Conv3x3> {
    type State = ();

    fn forward(&self, [x]: [&[f32]; 1]) -> (Vec<f32>, ()) {
        let mut y = Vec::new();
        let epilogue = Epilogue { bias: Some(&self.folded.bias), relu: true };
        self.conv.forward(x, &self.conv.pack(&self.folded.weight), epilogue, &mut y);
        (y, ())
    }

    fn backward(&self, _: [&[f32]; 1], (): &(), _: &[f32], _: [bool; 1]) -> [Option<Vec<f32>>; 1] {
        unreachable!("inference has no graph")
    }

    fn shape(&self) -> Vec<usize> {
        Kernel::<2>::shape(&self.conv)
    }
}

impl Kernel<1> for Inference<TransposedConv> {
    type State = ();

    fn forward(&self, [x]: [&[f32]; 1]) -> (Vec<f32>, ()) {
        let mut y = Vec::new();
        let epilogue = Epilogue { bias: Some(&self.folded.bias), relu: true };
        self.conv.forward(x, &self.conv.pack(&self.folded.weight), epilogue, &mut y);
        (y, ())
    }

    fn backward(&self, _: [&[f32]; 1], (): &(), _: &[f32], _: [bool; 1]) -> [Option<Vec<f32>>; 1] {
        unreachable!("inference has no graph")
    }

    fn shape(&self) -> Vec<usize> {
        Kernel::<2>::shape(&self.conv)
    }
}

/// Only for tensors without autodiff graph: a folded weight has no gradient.
fn plain(x: &Tensor<4>) -> Option<Input> {
    input(x).filter(|x| matches!(x, Input::Plain(_)))
}

/// A 3x3 convolution with folded batch norm and ReLU; for tensors without autodiff graph.
///
/// # Shapes
/// As [`conv3x3`].
pub fn folded_conv3x3(x: &Tensor<4>, stride: usize, folded: impl FnOnce() -> Folded) -> Option<Tensor<4>> {
    let plain = plain(x)?;
    let folded = folded();
    let conv = conv(x.dims(), folded.bias.len(), stride)?;
    apply(Inference { conv, folded }, [Some(plain)]).map(|(y, ())| y)
}

fn transposed_conv(x: [usize; 4], outputs: usize, stride: usize) -> Option<TransposedConv> {
    let [batch, inputs, height, width] = x;
    let known = TransposedConv::STRIDES.contains(&stride);
    known.then_some(TransposedConv { batch, inputs, outputs, height, width, stride })
}

impl Kernel<2> for TransposedConv {
    type State = ();

    fn forward(&self, [x, weight]: [&[f32]; 2]) -> (Vec<f32>, ()) {
        let mut y = Vec::new();
        TransposedConv::forward(self, x, &self.pack(weight), Epilogue::default(), &mut y);
        (y, ())
    }

    fn backward(&self, [x, weight]: [&[f32]; 2], (): &(), dy: &[f32], wanted: [bool; 2]) -> [Option<Vec<f32>>; 2] {
        let dx = wanted[0].then(|| {
            let mut dx = Vec::new();
            self.data_gradient(dy, weight, &mut dx);
            dx
        });
        [dx, wanted[1].then(|| self.weight_gradient(x, dy))]
    }

    fn shape(&self) -> Vec<usize> {
        vec![self.batch, self.outputs, self.height * self.stride, self.width * self.stride]
    }
}

/// Transposed convolution with kernel = stride, 1, 2 or 4.
///
/// # Shapes
/// `x`: `[B, C_in, H, W]`; `weight`: `[C_in, C_out, stride, stride]`; result `[B, C_out, H * stride, W * stride]`.
pub fn transposed(x: &Tensor<4>, weight: &Tensor<4>, stride: usize) -> Option<Tensor<4>> {
    let conv = transposed_conv(x.dims(), weight.dims()[1], stride)?;
    apply(conv, [input(x), input(weight)]).map(|(y, ())| y)
}

/// A transposed convolution with folded batch norm and ReLU; for tensors without autodiff graph.
///
/// # Shapes
/// As [`transposed`].
pub fn folded_transposed(x: &Tensor<4>, stride: usize, folded: impl FnOnce() -> Folded) -> Option<Tensor<4>> {
    let plain = plain(x)?;
    let folded = folded();
    let conv = transposed_conv(x.dims(), folded.bias.len(), stride)?;
    apply(Inference { conv, folded }, [Some(plain)]).map(|(y, ())| y)
}
