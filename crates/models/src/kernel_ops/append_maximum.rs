//! The maximum over a group of rows, appended to each of its rows.

use super::{Kernel, apply, input};
use crate::point_ops::Groups;
use burn::tensor::Tensor;
use kernels::GroupedRows;
use std::sync::Arc;

#[derive(Clone, Debug)]
struct AppendMaximum {
    groups: Arc<Groups>,
    channels: usize,
}

impl AppendMaximum {
    fn rows(&self) -> GroupedRows<'_> {
        GroupedRows { channels: self.channels, ends: &self.groups.ends }
    }
}

impl Kernel<1> for AppendMaximum {
    /// The row of each maximum.
    type State = Arc<[u32]>;

    fn forward(&self, [x]: [&[f32]; 1]) -> (Vec<f32>, Arc<[u32]>) {
        let mut y = Vec::new();
        let sources = self.rows().append_maximum(x, &mut y);
        (y, sources.into())
    }

    fn backward(&self, _: [&[f32]; 1], sources: &Arc<[u32]>, dy: &[f32], _: [bool; 1]) -> [Option<Vec<f32>>; 1] {
        let mut dx = Vec::new();
        self.rows().gradient(dy, sources, &mut dx);
        [Some(dx)]
    }

    fn shape(&self) -> Vec<usize> {
        vec![self.groups.source.len(), 2 * self.channels]
    }
}

/// Each row followed by the maximum over its group.
///
/// # Shapes
/// `x`: `[N, C]`; result `[N, 2 C]`.
pub fn append_maximum(x: &Tensor<2>, groups: &Arc<Groups>) -> Option<Tensor<2>> {
    let kernel = AppendMaximum { groups: groups.clone(), channels: x.dims()[1] };
    apply(kernel, [input(x)]).map(|(y, _)| y)
}
