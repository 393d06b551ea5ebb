//! The anchor head (OpenPCDet: `AnchorHeadSingle`).

use crate::layers::{Init, PointwiseConv};
use burn::module::Module;
use burn::tensor::Tensor;

/// Three 1x1 convolutions: classes, boxes, direction bins.
#[derive(Module, Debug)]
pub struct AnchorHead {
    /// Output channels: anchors per cell times classes.
    pub conv_cls: PointwiseConv,
    /// Output channels: anchors per cell times 7.
    pub conv_box: PointwiseConv,
    /// Output channels: anchors per cell times bins.
    pub conv_dir_cls: PointwiseConv,
}

/// Outputs of the head for every anchor, in the order `[y, x, class, rotation]`.
#[derive(Clone, Debug)]
pub struct Predictions {
    /// Logits, `[B, A, classes]`.
    pub cls: Tensor<3>,
    /// Residuals, `[B, A, 7]`.
    pub boxes: Tensor<3>,
    /// Logits of the direction bins, `[B, A, bins]`.
    pub dir: Tensor<3>,
    /// Height and width of the feature map.
    pub map: [usize; 2],
}

impl AnchorHead {
    /// `anchors`: anchors per cell.
    pub fn new(inputs: usize, anchors: usize, classes: usize, bins: usize, init: &Init<'_>) -> Self {
        let mut conv_cls = PointwiseConv::new("dense_head.conv_cls", [inputs, anchors * classes], init);
        // Initial probability of background: 0.99 for every anchor.
        conv_cls.bias = init.constant([anchors * classes], -(99f32.ln()));
        let mut conv_box = PointwiseConv::new("dense_head.conv_box", [inputs, anchors * 7], init);
        conv_box.weight = init.normal("dense_head.conv_box.weight", [anchors * 7, inputs, 1, 1], 0.001);
        AnchorHead {
            conv_cls,
            conv_box,
            conv_dir_cls: PointwiseConv::new("dense_head.conv_dir_cls", [inputs, anchors * bins], init),
        }
    }

    /// # Shapes
    /// `x`: `[B, C, H, W]`.
    pub fn forward(&self, x: Tensor<4>) -> Predictions {
        let [b, _, h, w] = x.dims();
        let anchors = self.conv_box.bias.dims()[0] / 7;
        let convs = [&self.conv_cls, &self.conv_box, &self.conv_dir_cls];
        let [cls, boxes, dir] = PointwiseConv::forward_rows(convs, x).map(|y| {
            let k = y.dims()[1];
            y.reshape([b, h * w * anchors, k / anchors]) // [B, A, k]
        });
        Predictions { cls, boxes, dir, map: [h, w] }
    }
}
