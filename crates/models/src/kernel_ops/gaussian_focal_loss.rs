//! The focal loss of heat maps.

use super::{Kernel, apply, input};
use burn::tensor::Tensor;
use std::sync::Arc;

#[derive(Clone, Debug)]
struct GaussianFocalLoss {
    heat_map: Arc<[f32]>,
    scale: f32,
}

impl Kernel<1> for GaussianFocalLoss {
    /// The gradient, computed together with the loss.
    type State = Arc<[f32]>;

    fn forward(&self, [logits]: [&[f32]; 1]) -> (Vec<f32>, Arc<[f32]>) {
        let mut gradient = Vec::new();
        let loss = kernels::gaussian_focal_loss(logits, &self.heat_map, self.scale, &mut gradient);
        (vec![loss as f32], gradient.into())
    }

    fn backward(&self, _: [&[f32]; 1], gradient: &Arc<[f32]>, dy: &[f32], _: [bool; 1]) -> [Option<Vec<f32>>; 1] {
        [Some(gradient.iter().map(|g| g * dy[0]).collect())]
    }

    fn shape(&self) -> Vec<usize> {
        vec![1]
    }
}

/// `scale` times the sum of the loss over all cells.
///
/// # Shapes
/// `logits`: any; `heat_map`: as many values, row-major; result `[1]`.
pub fn gaussian_focal_loss<const D: usize>(logits: &Tensor<D>, heat_map: &[f32], scale: f32) -> Option<Tensor<1>> {
    apply(GaussianFocalLoss { heat_map: heat_map.into(), scale }, [input(logits)]).map(|(loss, _)| loss)
}
