//! The sum of the sigmoid focal loss over all anchors.

use super::{Kernel, apply, input};
use burn::tensor::Tensor;
use std::sync::Arc;

#[derive(Clone, Debug)]
struct FocalLoss {
    classes: usize,
    labels: Arc<[i32]>,
    weights: Arc<[f32]>,
}

impl Kernel<1> for FocalLoss {
    /// The gradient, computed together with the loss.
    type State = Arc<[f32]>;

    fn forward(&self, [logits]: [&[f32]; 1]) -> (Vec<f32>, Arc<[f32]>) {
        let mut gradient = Vec::new();
        let loss = kernels::sigmoid_focal_loss(logits, self.classes, &self.labels, &self.weights, &mut gradient);
        (vec![loss as f32], gradient.into())
    }

    fn backward(&self, _: [&[f32]; 1], gradient: &Arc<[f32]>, dy: &[f32], _: [bool; 1]) -> [Option<Vec<f32>>; 1] {
        [Some(gradient.iter().map(|g| g * dy[0]).collect())]
    }

    fn shape(&self) -> Vec<usize> {
        vec![1]
    }
}

/// The weighted sum over all rows and classes.
///
/// # Shapes
/// `logits`: `[N, C]`; `labels`: N, k for the class with index k - 1, no class for 0 and below; `weights`: N.
pub fn focal_loss_sum(logits: &Tensor<2>, labels: &[i32], weights: &[f32]) -> Option<Tensor<1>> {
    let classes = logits.dims()[1];
    apply(FocalLoss { classes, labels: labels.into(), weights: weights.into() }, [input(logits)]).map(|(loss, _)| loss)
}
