//! Pillars onto the bird's eye canvas (OpenPCDet: `PointPillarScatter`).

use burn::tensor::{IndexingUpdateOp, Int, Tensor, TensorData};

/// Puts each pillar's features at its cell; the rest of the canvas is zero.
///
/// # Shapes
/// `features`: `[P, C]`; `cells`: P indices into `[B, H, W]`, row-major, all different; result `[B, C, H, W]`.
pub fn scatter(features: Tensor<2>, cells: Vec<i32>, canvas: [usize; 3]) -> Tensor<4> {
    let [b, h, w] = canvas;
    let [p, c] = features.dims();
    let device = features.device();
    let index = Tensor::<1, Int>::from_data(TensorData::new(cells, [p]), &device);
    Tensor::zeros([b * h * w, c], &device)
        .select_assign(0, index, features, IndexingUpdateOp::Add) // [B * H * W, C]
        .reshape([b, h, w, c])
        .permute([0, 3, 1, 2]) // [B, C, H, W]
}
