//! Pillars onto the canvas, and the convolution that reads it.

use super::convolution::conv;
use super::{Input, Kernel, apply, input};
use burn::tensor::Tensor;
use kernels::{Canvas, Conv3x3, Epilogue};
use std::sync::Arc;

#[derive(Clone, Debug)]
struct Scatter {
    canvas: Canvas,
    cells: Arc<[u32]>,
    shape: [usize; 4],
}

impl Kernel<1> for Scatter {
    type State = ();

    fn forward(&self, [features]: [&[f32]; 1]) -> (Vec<f32>, ()) {
        let mut y = Vec::new();
        self.canvas.scatter(features, &self.cells, &mut y);
        (y, ())
    }

    fn backward(&self, _: [&[f32]; 1], (): &(), dy: &[f32], _: [bool; 1]) -> [Option<Vec<f32>>; 1] {
        let mut dx = Vec::new();
        self.canvas.gather(dy, &self.cells, &mut dx);
        [Some(dx)]
    }

    fn shape(&self) -> Vec<usize> {
        self.shape.to_vec()
    }
}

/// Each pillar's features at its cell, zeros elsewhere.
///
/// # Shapes
/// `features`: `[P, C]`; `cells`: P indices into `[B, H, W]`, row-major, all different, sorted by canvas; result `[B,
/// C, H, W]`.
pub fn scatter(features: &Tensor<2>, cells: &[u32], [batch, height, width]: [usize; 3]) -> Option<Tensor<4>> {
    let features_input = input(features)?;
    let channels = features.dims()[1];
    let canvas = Canvas { batch, channels, pixels: height * width };
    let kernel = Scatter { canvas, cells: cells.into(), shape: [batch, channels, height, width] };
    apply(kernel, [Some(features_input)]).map(|(y, ())| y)
}

/// The scatter and a convolution of stride 2 behind it, whose gradient is computed at the pillars only.
#[derive(Clone, Debug)]
struct PillarConv {
    canvas: Canvas,
    cells: Arc<[u32]>,
    conv: Conv3x3,
}

impl Kernel<2> for PillarConv {
    /// The canvas.
    type State = Arc<Vec<f32>>;

    fn forward(&self, [features, weight]: [&[f32]; 2]) -> (Vec<f32>, Self::State) {
        let (mut x, mut y) = (Vec::new(), Vec::new());
        self.canvas.scatter(features, &self.cells, &mut x);
        self.conv.forward(&x, &self.conv.pack(weight), Epilogue::default(), &mut y);
        (y, Arc::new(x))
    }

    fn backward(
        &self,
        [_, weight]: [&[f32]; 2],
        x: &Self::State,
        dy: &[f32],
        wanted: [bool; 2],
    ) -> [Option<Vec<f32>>; 2] {
        let by_features = wanted[0].then(|| {
            let mut gradient = Vec::new();
            self.conv.data_gradient_at(dy, weight, &self.cells, &mut gradient);
            gradient
        });
        [by_features, wanted[1].then(|| self.conv.weight_gradient(x, dy))]
    }

    fn shape(&self) -> Vec<usize> {
        Kernel::<2>::shape(&self.conv)
    }
}

/// [`scatter`] and [`conv3x3`](super::conv3x3) of stride 2 behind it as one operation: the same bits, and in the
/// backward pass no gradient of the cells without pillars. For tensors with autodiff graph.
///
/// # Shapes
/// As [`scatter`]; `weight`: `[C_out, C, 3, 3]`; result `[B, C_out, H / 2, W / 2]`.
pub fn pillar_conv(
    features: &Tensor<2>,
    cells: &[u32],
    [batch, height, width]: [usize; 3],
    weight: &Tensor<4>,
) -> Option<Tensor<4>> {
    let features_input = input(features).filter(|input| matches!(input, Input::Tracked(_)))?;
    let channels = features.dims()[1];
    let canvas = Canvas { batch, channels, pixels: height * width };
    let conv = conv([batch, channels, height, width], weight.dims()[0], 2)?;
    apply(PillarConv { canvas, cells: cells.into(), conv }, [Some(features_input), input(weight)]).map(|(y, _)| y)
}
