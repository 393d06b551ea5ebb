//! Layers shared by all points of a group, and the maximum over it (Qi et al. 2017, PointNet).

use crate::layers::{Mode, RowsBnRelu};
use crate::point_ops::{GroupTensors, group_max};
use burn::module::Module;
use burn::tensor::Tensor;

/// The layers of one grouping.
#[derive(Module, Debug)]
pub struct SharedMlp {
    /// In order.
    pub layers: Vec<RowsBnRelu<4>>,
}

impl SharedMlp {
    /// For points with `inputs` features beside their offsets; `layer` makes the layer of an index and its channels.
    pub fn new(inputs: usize, filters: &[usize], layer: impl Fn(usize, [usize; 2]) -> RowsBnRelu<4>) -> Self {
        let mut from = 3 + inputs;
        let mut layers = Vec::new();
        for (j, &filters) in filters.iter().enumerate() {
            layers.push(layer(j, [from, filters]));
            from = filters;
        }
        SharedMlp { layers }
    }

    /// Offsets and features of each neighbour through the layers, then the maximum over the group.
    ///
    /// The first layer's share of the features is computed before grouping: a point is the neighbour of many centres.
    ///
    /// # Shapes
    /// `features`: `[P, C]`; result `[G, C']`.
    pub fn forward(&self, features: Option<Tensor<2>>, groups: &GroupTensors, mode: Mode) -> Tensor<2> {
        let (first, rest) = (&self.layers[0], &self.layers[1..]);
        let mut y = first.project(groups.offset.clone(), 0); // [N, C]
        if let Some(features) = features {
            y = y + first.project(features, 3).select(0, groups.source.clone());
        }
        let x = first.norm_relu(y, &groups.counts, mode);
        let x = rest.iter().fold(x, |x, layer| layer.forward(x, &groups.counts, mode)); // [N, C']
        group_max(x, groups)
    }
}
