//! Scatter of pillar features to the BEV canvas (OpenPCDet: `PointPillarScatter`).

use crate::{kernel_ops, row_ops};
use burn::tensor::Tensor;

/// Writes each pillar's features to its cell; the rest of the canvas is zero.
///
/// # Shapes
/// `features`: `[P, C]`; `cells`: P indices into `[B, H, W]`, row-major, all different, sorted by canvas; result `[B,
/// C, H, W]`.
pub fn scatter(features: Tensor<2>, cells: &[u32], canvas: [usize; 3]) -> Tensor<4> {
    kernel_ops::scatter(&features, cells, canvas).unwrap_or_else(|| scatter_on_device(features, cells, canvas))
}

/// The same by rows: each goes to its cell, and in the backward pass each pillar reads its cell.
fn scatter_on_device(features: Tensor<2>, cells: &[u32], canvas: [usize; 3]) -> Tensor<4> {
    let [b, h, w] = canvas;
    let c = features.dims()[1];
    let rows = row_ops::place(features, &cells.into(), b * h * w); // [B * H * W, C]
    rows.reshape([b, h, w, c]).permute([0, 3, 1, 2]) // [B, C, H, W]
}

/// A canvas that is zero but for its pillars.
#[derive(Clone, Debug)]
pub struct PillarCanvas {
    /// Features of the pillars, `[P, C]`.
    pub features: Tensor<2>,
    /// Index of each pillar's cell in `shape`, as [`scatter`] wants them.
    pub cells: Vec<u32>,
    /// `[B, H, W]`.
    pub shape: [usize; 3],
}

impl PillarCanvas {
    /// The canvas as an image, `[B, C, H, W]`.
    pub fn image(&self) -> Tensor<4> {
        scatter(self.features.clone(), &self.cells, self.shape)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layers::host;
    use burn::tensor::{Device, TensorData};

    #[test]
    fn both_forms_give_the_same_values_and_gradients() {
        let device = Device::flex().autodiff();
        let (cells, canvas) = ([7u32, 2, 13, 12, 23], [2, 3, 4]);
        let values: Vec<f32> = (0..15).map(|i| i as f32 - 6.5).collect();
        let features = Tensor::<2>::from_data(TensorData::new(values, [5, 3]), &device).require_grad();
        let ours = kernel_ops::scatter(&features, &cells, canvas).unwrap();
        let theirs = scatter_on_device(features.clone(), &cells, canvas);
        assert_eq!(ours.dims(), [2, 3, 3, 4]);
        assert_eq!(host(ours.clone()).unwrap(), host(theirs.clone()).unwrap());
        let gradient = |y: Tensor<4>| {
            let squares = (y.clone() * y).sum().backward();
            host(features.grad(&squares).unwrap()).unwrap()
        };
        assert_eq!(gradient(ours), gradient(theirs));
    }
}
