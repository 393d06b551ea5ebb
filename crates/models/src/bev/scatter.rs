//! Scatter of pillar features to the BEV canvas (OpenPCDet: `PointPillarScatter`).

use crate::kernel_ops;
use burn::tensor::{IndexingUpdateOp, Int, Tensor, TensorData};

/// Writes each pillar's features to its cell; the rest of the canvas is zero.
///
/// # Shapes
/// `features`: `[P, C]`; `cells`: P indices into `[B, H, W]`, row-major, all different, sorted by canvas; result `[B,
/// C, H, W]`.
pub fn scatter(features: Tensor<2>, cells: &[u32], canvas: [usize; 3]) -> Tensor<4> {
    kernel_ops::scatter(&features, cells, canvas).unwrap_or_else(|| scatter_on_device(features, cells, canvas))
}

/// The same with burn's operations.
fn scatter_on_device(features: Tensor<2>, cells: &[u32], canvas: [usize; 3]) -> Tensor<4> {
    let [b, h, w] = canvas;
    let [p, c] = features.dims();
    let device = features.device();
    let index = Tensor::<1, Int>::from_data(
        TensorData::new(cells.iter().map(|&cell| cell as i32).collect::<Vec<_>>(), [p]),
        &device,
    );
    Tensor::zeros([b * h * w, c], &device)
        .select_assign(0, index, features, IndexingUpdateOp::Add) // [B * H * W, C]
        .reshape([b, h, w, c])
        .permute([0, 3, 1, 2]) // [B, C, H, W]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layers::host;
    use burn::tensor::Device;

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
