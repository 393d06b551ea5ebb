//! The network of the second stage (Shi et al. 2019, PointRCNN, section 3.3; OpenPCDet: `PointRCNNHead`).

use super::backbone::SetAbstraction;
use super::config::RoiHeadConfig;
use super::point_head::HiddenLayers;
use super::roi_input::{PREFIX, RoiInput};
use super::set_abstraction::SharedMlp;
use crate::layers::{BatchNorm, Init, Mode, RowCounts, RowsBnRelu, RowsLinear};
use crate::row_ops;
use burn::module::Module;
use burn::tensor::activation::relu;
use burn::tensor::{Tensor, TensorData};

/// Refines regions of interest. Its set abstraction has batch norm, as in OpenPCDet, where `USE_BN` has no effect on
/// it.
#[derive(Module, Debug)]
pub struct RoiHead {
    /// Levels inside a region, then one over the whole region.
    pub sa_modules: Vec<SetAbstraction>,
    /// Layers over position, score and distance of a point.
    pub xyz_up_layer: Vec<RowsLinear<4>>,
    /// Layer over the former concatenated with the point's features.
    pub merge_down_layer: Vec<RowsLinear<4>>,
    /// Branch of the score.
    pub cls_layers: HiddenLayers<3>,
    /// Branch of the box.
    pub reg_layers: HiddenLayers<3>,
}

/// Intermediate outputs of the second stage. P rows of points, see [`RoiInput`]; R regions.
#[derive(Clone, Debug)]
pub struct RoiStages {
    /// `[P, C]`.
    pub xyz_up: Tensor<2>,
    /// `[P, C]`.
    pub merged: Tensor<2>,
    /// Output of each level, rows as in [`RoiInput::dense`]; the last one `[R, C]`.
    pub set_abstraction: Vec<Tensor<2>>,
    /// Logits, `[R, 1]`.
    pub cls: Tensor<2>,
    /// Residuals, `[R, 7]`.
    pub reg: Tensor<2>,
}

impl RoiHead {
    /// For points with `inputs` features.
    pub fn new(inputs: usize, config: &RoiHeadConfig, init: &Init<'_>) -> Self {
        let norm = |channels| BatchNorm::new(channels, 0.1, 1e-5, init);
        let [first, second] = config.xyz_filters;
        let linear = |name: &str, channels| RowsLinear::xavier(&format!("roi_head.{name}"), channels, init);
        let filters = config.levels.iter().map(|l| &l.filters).chain([&config.global_filters]);
        let mut from = second;
        let mut sa_modules = Vec::new();
        for (i, filters) in filters.enumerate() {
            let name = format!("roi_head.SA_modules.{i}.mlps.0");
            let mlp = SharedMlp::new(from, filters, |j, c| {
                RowsBnRelu::xavier(&format!("{name}.{}.weight", 3 * j), c, norm(c[1]), init)
            });
            sa_modules.push(SetAbstraction { mlps: vec![mlp] });
            from = filters[filters.len() - 1];
        }
        let chain = |name: &str, [first, second]: [usize; 2], outputs: usize| {
            let hidden = |index: usize, c: [usize; 2]| {
                RowsBnRelu::xavier(&format!("roi_head.{name}.{index}.weight"), c, norm(c[1]), init)
            };
            HiddenLayers {
                hidden: vec![hidden(0, [from, first]), hidden(4, [first, second])],
                last: RowsLinear::xavier(&format!("roi_head.{name}.7"), [second, outputs], init),
            }
        };
        let mut reg_layers = chain("reg_layers", config.box_filters, 7);
        let inputs_of_last = config.box_filters[1];
        reg_layers.last.weight = init.normal("roi_head.reg_layers.7.weight", [7, inputs_of_last, 1], 0.001);
        RoiHead {
            sa_modules,
            xyz_up_layer: vec![linear("xyz_up_layer.0", [PREFIX, first]), linear("xyz_up_layer.2", [first, second])],
            merge_down_layer: vec![linear("merge_down_layer.0", [second + inputs, second])],
            cls_layers: chain("cls_layers", config.class_filters, 1),
            reg_layers,
        }
    }

    /// No gradient reaches `point_features`, as in the reference.
    ///
    /// # Shapes
    /// `point_features`: `[B * N, C]`.
    pub fn forward(&self, point_features: Tensor<2>, input: &RoiInput, mode: Mode) -> RoiStages {
        let device = point_features.device();
        let points = input.prefix.len();
        let prefix = TensorData::new(input.prefix.as_flattened().to_vec(), [points, PREFIX]);
        let prefix = Tensor::<2>::from_data(prefix, &device); // [P, 5]
        let xyz_up = self.xyz_up_layer.iter().fold(prefix, |x, layer| relu(layer.forward(x)));

        let source = input.source.iter().map(|row| row.unwrap_or(row_ops::ZERO)).collect();
        let features = row_ops::gather(point_features.detach(), &source); // [P, C]
        let merge = &self.merge_down_layer[0];
        let positions = xyz_up.dims()[1];
        let merged =
            merge.project(xyz_up.clone(), 0) + merge.project(features, positions) + merge.bias.val().unsqueeze();
        let merged = relu(merged); // [P, C]

        let mut set_abstraction: Vec<Tensor<2>> = Vec::new();
        for (module, groups) in self.sa_modules.iter().zip(input.levels.iter().chain([&input.global])) {
            let from = set_abstraction.last().unwrap_or(&merged).clone();
            set_abstraction.push(module.mlps[0].forward(Some(from), groups.clone(), &device, mode));
        }
        let regions = set_abstraction[set_abstraction.len() - 1].clone(); // [R, C]
        let counts = RowCounts::once(input.regions(), &device);
        let cls = self.cls_layers.forward(regions.clone(), &counts, mode);
        let reg = self.reg_layers.forward(regions, &counts, mode);
        RoiStages { xyz_up, merged, set_abstraction, cls, reg }
    }
}
