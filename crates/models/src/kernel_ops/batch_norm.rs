//! Batch norm with the ReLU behind it by the kernels.

use super::operation::{Argument, Operation, run};
use super::{algorithm, moments};
use crate::layers::Moments;
use burn::tensor::Tensor;
use kernels::{BatchNorm, Statistics};

/// Normalises by the statistics of `x`, which are returned for the running ones.
///
/// # Shapes
/// `x`: `[B, C, ...]`, the result alike; `gamma`, `beta`: `[C]`. `None` where there is no kernel.
pub fn batch_norm_relu<const D: usize>(
    x: &Tensor<D>,
    gamma: &Tensor<1>,
    beta: &Tensor<1>,
    epsilon: f64,
) -> Option<(Tensor<D>, Moments)> {
    algorithm()?;
    let shape = x.dims().to_vec();
    let pixels = shape[2..].iter().product();
    let norm = BatchNorm { batch: shape[0], channels: shape[1], pixels, epsilon, relu: true };
    let arguments = [Argument::of(x)?, Argument::of(gamma)?, Argument::of(beta)?];
    let (y, statistics) = run(Shaped { norm, shape }, arguments)?;
    let moments = moments(&statistics, norm.batch * pixels, &y.device());
    Some((y, moments))
}

#[derive(Clone, Debug)]
struct Shaped {
    norm: BatchNorm,
    shape: Vec<usize>,
}

impl Operation<3> for Shaped {
    type State = Statistics;

    fn forward(&self, [x, gamma, beta]: [&[f32]; 3]) -> (Vec<f32>, Vec<usize>, Statistics) {
        let mut y = Vec::new();
        let statistics = self.norm.forward_train(x, gamma, beta, &mut y);
        (y, self.shape.clone(), statistics)
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
}
