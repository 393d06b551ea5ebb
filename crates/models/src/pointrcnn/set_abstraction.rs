//! Shared layers over the points of a group, followed by the maximum over the group (Qi et al. 2017, PointNet).

use crate::kernel_ops::MlpRows;
use crate::layers::{Mode, RowsBnRelu, rows_kernel};
use crate::point_ops::{GroupTensors, Groups, group_max};
use crate::row_ops;
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use std::sync::Arc;

/// The layers of one grouping.
#[derive(Module, Debug)]
pub struct SharedMlp {
    /// The layers, in order.
    pub layers: Vec<RowsBnRelu<4>>,
}

impl SharedMlp {
    /// For points with `inputs` features in addition to their offsets; `layer` creates the layer of an index with given
    /// channels.
    pub fn new(inputs: usize, filters: &[usize], layer: impl Fn(usize, [usize; 2]) -> RowsBnRelu<4>) -> Self {
        let mut from = 3 + inputs;
        let mut layers = Vec::new();
        for (j, &filters) in filters.iter().enumerate() {
            layers.push(layer(j, [from, filters]));
            from = filters;
        }
        SharedMlp { layers }
    }

    /// Applies the layers to offsets and features of each neighbour, then takes the maximum over the group.
    ///
    /// The first layer's product with the features is computed before grouping, because a point is the neighbour of
    /// many centres.
    ///
    /// # Shapes
    /// `features`: `[P, C]`; result `[G, C']`.
    pub fn forward(&self, features: Option<Tensor<2>>, groups: Groups, device: &Device, mode: Mode) -> Tensor<2> {
        let groups = Arc::new(groups);
        let projected = features.map(|features| self.layers[0].project(features, 3)); // [P, C]
        let rows = match &projected {
            Some(projected) => MlpRows::Gathered(projected.clone()),
            None => MlpRows::Rows(groups.offsets(device)),
        };
        rows_kernel(&self.layers, &rows, Some(&groups), mode)
            .unwrap_or_else(|| self.forward_on_device(projected, &groups.to_device(device), mode))
    }

    /// The same with burn's operations, after the first layer's product with the features.
    fn forward_on_device(&self, projected: Option<Tensor<2>>, groups: &GroupTensors, mode: Mode) -> Tensor<2> {
        let (first, rest) = (&self.layers[0], &self.layers[1..]);
        let mut y = first.project(groups.offset.clone(), 0); // [N, C]
        if let Some(projected) = projected {
            y = y + row_ops::gather(projected, &groups.source);
        }
        let x = first.norm_relu(y, &groups.counts, mode);
        let x = rest.iter().fold(x, |x, layer| layer.forward(x, &groups.counts, mode)); // [N, C']
        group_max(x, groups)
    }
}
