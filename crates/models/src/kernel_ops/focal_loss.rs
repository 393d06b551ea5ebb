//! The focal loss by the kernel.

use super::algorithm;
use super::operation::{Argument, Operation, run};
use burn::tensor::Tensor;
use kernels::sigmoid_focal_loss;
use std::sync::Arc;

/// The sum over all entries of the sigmoid focal loss with alpha 0.25 and gamma 2, each row weighted.
///
/// # Shapes
/// `logits`: `[N, C]`; `labels`: N, 0 for background, k for the class with index k - 1; `weights`: N; result `[1]`. `None` where there is no
/// kernel.
pub fn focal_loss_sum(logits: &Tensor<2>, labels: &[i32], weights: &[f32]) -> Option<Tensor<1>> {
    algorithm()?;
    let [_, classes] = logits.dims();
    let operation = FocalLoss { classes, labels: labels.into(), weights: weights.into() };
    Some(run(operation, [Argument::of(logits)?])?.0)
}

#[derive(Clone, Debug)]
struct FocalLoss {
    classes: usize,
    labels: Arc<[i32]>,
    weights: Arc<[f32]>,
}

impl Operation<1> for FocalLoss {
    /// The gradient.
    type State = Vec<f32>;

    fn forward(&self, [logits]: [&[f32]; 1]) -> (Vec<f32>, Vec<usize>, Vec<f32>) {
        let mut gradient = Vec::new();
        let loss = sigmoid_focal_loss(logits, self.classes, &self.labels, &self.weights, &mut gradient);
        (vec![loss as f32], vec![1], gradient)
    }

    fn backward(&self, _: [&[f32]; 1], state: &Vec<f32>, gradient: &[f32], _: [bool; 1]) -> [Option<Vec<f32>>; 1] {
        let scale = gradient[0];
        [Some(state.iter().map(|g| g * scale).collect())]
    }
}
