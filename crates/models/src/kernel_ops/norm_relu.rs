//! Batch normalisation with the statistics of the batch, optionally followed by a ReLU.

use super::{Kernel, apply, input};
use burn::tensor::Tensor;
use kernels::{BatchNorm, Statistics};

#[derive(Clone, Debug)]
struct NormRelu {
    norm: BatchNorm,
    shape: Vec<usize>,
}

impl Kernel<3> for NormRelu {
    type State = Statistics;

    fn forward(&self, [x, gamma, beta]: [&[f32]; 3]) -> (Vec<f32>, Statistics) {
        let mut y = Vec::new();
        let statistics = self.norm.forward_train(x, gamma, beta, &mut y);
        (y, statistics)
    }

    fn backward(
        &self,
        [x, gamma, beta]: [&[f32]; 3],
        statistics: &Statistics,
        dy: &[f32],
        _: [bool; 3],
    ) -> [Option<Vec<f32>>; 3] {
        let mut dx = Vec::new();
        let (dgamma, dbeta) = self.norm.backward((x, dy), (gamma, beta), statistics, &mut dx);
        [Some(dx), Some(dgamma), Some(dbeta)]
    }

    fn shape(&self) -> Vec<usize> {
        self.shape.clone()
    }
}

/// The normalised batch, with a ReLU if `relu`, and its statistics.
///
/// # Shapes
/// `x` and result: `[B, C, ...]`; `gamma`, `beta`: `[C]`.
pub fn norm_relu<const D: usize>(
    x: &Tensor<D>,
    gamma: &Tensor<1>,
    beta: &Tensor<1>,
    epsilon: f64,
    relu: bool,
) -> Option<(Tensor<D>, Statistics)> {
    let shape = x.dims().to_vec();
    let norm = BatchNorm { batch: shape[0], channels: shape[1], pixels: shape[2..].iter().product(), epsilon, relu };
    apply(NormRelu { norm, shape }, [input(x), input(gamma), input(beta)])
}
