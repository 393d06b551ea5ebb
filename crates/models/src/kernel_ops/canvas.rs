//! Pillars onto the canvas.

use super::{Kernel, apply, input};
use burn::tensor::Tensor;
use kernels::Canvas;
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
