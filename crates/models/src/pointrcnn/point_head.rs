//! The head of the first stage: classes and boxes of points (OpenPCDet: `PointHeadBox`).

use super::config::PointHeadConfig;
use crate::kernel_ops::MlpRows;
use crate::layers::{BatchNorm, Init, Mode, RowCounts, RowsBnRelu, RowsLinear, rows_kernel};
use burn::module::Module;
use burn::tensor::Tensor;

/// Length of the code of a box at a point.
pub const POINT_CODE: usize = 8;

/// Two branches of layers over each point's features.
#[derive(Module, Debug)]
pub struct PointHead {
    /// Branch of the class logits.
    pub cls_layers: HiddenLayers<2>,
    /// Branch of the box codes.
    pub box_layers: HiddenLayers<2>,
}

/// Two hidden layers and an output layer.
#[derive(Module, Debug)]
pub struct HiddenLayers<const D: usize> {
    /// Hidden layers with batch norm.
    pub hidden: Vec<RowsBnRelu<D>>,
    /// Output layer without batch norm.
    pub last: RowsLinear<D>,
}

/// Outputs of the head for every point. The clouds of a batch are concatenated.
#[derive(Clone, Debug)]
pub struct PointPredictions {
    /// Logits, `[B * N, classes]`.
    pub cls: Tensor<2>,
    /// Codes, `[B * N, 8]`.
    pub boxes: Tensor<2>,
}

impl PointHead {
    /// For points with `inputs` features.
    pub fn new(inputs: usize, classes: usize, config: &PointHeadConfig, init: &Init<'_>) -> Self {
        let chain = |name: &str, [first, second]: [usize; 2], outputs: usize| {
            let hidden = |index: usize, channels: [usize; 2]| {
                let norm = BatchNorm::new(channels[1], 0.1, 1e-5, init);
                RowsBnRelu::new(&format!("point_head.{name}.{index}.weight"), channels, norm, init)
            };
            HiddenLayers {
                hidden: vec![hidden(0, [inputs, first]), hidden(3, [first, second])],
                last: RowsLinear::new(&format!("point_head.{name}.6"), [second, outputs], init),
            }
        };
        PointHead {
            cls_layers: chain("cls_layers", config.class_filters, classes),
            box_layers: chain("box_layers", config.box_filters, POINT_CODE),
        }
    }

    /// # Shapes
    /// `features`: `[B * N, C]`.
    pub fn forward(&self, features: Tensor<2>, mode: Mode) -> PointPredictions {
        let counts = RowCounts::once(features.dims()[0], &features.device());
        PointPredictions {
            cls: self.cls_layers.forward(features.clone(), &counts, mode),
            boxes: self.box_layers.forward(features, &counts, mode),
        }
    }
}

impl<const D: usize> HiddenLayers<D> {
    /// # Shapes
    /// `x`: `[N, C]`; result `[N, outputs]`.
    pub fn forward(&self, x: Tensor<2>, counts: &RowCounts, mode: Mode) -> Tensor<2> {
        let hidden = rows_kernel(&self.hidden, &MlpRows::Rows(x.clone()), None, mode);
        self.last.forward(hidden.unwrap_or_else(|| self.hidden.iter().fold(x, |x, l| l.forward(x, counts, mode))))
    }
}
