//! Pillar feature net (OpenPCDet: `PillarVFE`).

use crate::kernel_ops::{MlpGroups, MlpRows, append_maximum, pillar_net, pillar_net_inference};
use crate::layers::{BatchNorm, Init, Mode, RowsBnRelu, rows_kernel};
use crate::point_ops::{Groups, group_max};
use crate::row_ops;
use burn::module::Module;
use burn::tensor::{Tensor, TensorData};
use std::slice;
use std::sync::Arc;

/// Layers of linear without bias, batch normalisation and ReLU on the points of a pillar. The maximum over the pillar
/// follows the last layer. Each other layer has half of its channels, and the pillar's maximum over them is appended to
/// every point (OpenPCDet: `PFNLayer`).
///
/// The reference pads every pillar with zero rows up to `max_points` *before* the first layer. These rows count in the
/// statistics and in the maximum. All padding rows of a pillar are equal in every layer. One row with a multiplicity
/// represents them; with a single layer none is computed.
#[derive(Module, Debug)]
pub struct PillarVfe {
    /// Weights `[C, F]`; F = 10 with intensity and 9 without in the first layer.
    pub pfn_layers: Vec<RowsBnRelu<2>>,
    max_points: usize,
}

/// The points of all pillars of a batch, sorted by pillar, on the host.
#[derive(Clone, Debug)]
pub struct PillarRows {
    /// Decorated points, `[N, F]`.
    pub features: Arc<[f32]>,
    /// Points in each pillar; their sum is N.
    pub num_points: Arc<[u32]>,
}

impl PillarRows {
    /// The rows of the points, `[R, F]`, with one row of zeros after the points of each pillar that is not full. Each
    /// pillar is a group, whose index is the `source` of its rows; the row of zeros stands for all its padding.
    fn padded(&self, inputs: usize, max_points: usize) -> (Vec<f32>, Groups) {
        let rows = self.features.len() / inputs + self.num_points.len();
        let mut features = Vec::with_capacity(rows * inputs);
        let mut groups = Groups::default();
        let mut rest = &self.features[..];
        for (pillar, &points) in self.num_points.iter().enumerate() {
            let points = points as usize;
            let (own, others) = rest.split_at(points * inputs);
            rest = others;
            features.extend_from_slice(own);
            groups.count.resize(groups.count.len() + points, 1.0);
            if points < max_points {
                features.resize(features.len() + inputs, 0.0);
                groups.count.push((max_points - points) as f32);
            }
            groups.source.resize(groups.count.len(), pillar as u32);
            groups.ends.push(groups.count.len() as u32);
        }
        (features, groups)
    }
}

impl PillarVfe {
    /// For `inputs` values a point and layers of `filters` channels.
    pub fn new(inputs: usize, filters: &[usize], max_points: usize, init: &Init<'_>) -> Self {
        let last = filters.len().saturating_sub(1);
        let mut from = inputs;
        let mut pfn_layers = Vec::new();
        for (i, &filters) in filters.iter().enumerate() {
            let to = if i == last { filters } else { filters / 2 };
            let name = format!("vfe.pfn_layers.{i}.linear.weight");
            pfn_layers.push(RowsBnRelu::new(&name, [from, to], BatchNorm::new(to, 0.01, 1e-3, init), init));
            from = filters;
        }
        PillarVfe { pfn_layers, max_points }
    }

    /// # Shapes
    /// `rows.features`: `[N, F]`; result `[P, C]`.
    pub fn forward(&self, rows: PillarRows, mode: Mode) -> Tensor<2> {
        let by_kernel = match &self.pfn_layers[..] {
            [layer] => self.single(layer, &rows, mode),
            _ => self.stacked(&rows, mode),
        };
        by_kernel.unwrap_or_else(|| self.forward_on_device(&rows, mode))
    }

    /// A single layer and the maximum as one operation, if there is a kernel.
    fn single(&self, layer: &RowsBnRelu<2>, rows: &PillarRows, mode: Mode) -> Option<Tensor<2>> {
        let points = (rows.features.clone(), rows.num_points.clone());
        let (weight, norm) = (layer.weight.val(), &layer.norm);
        let (gamma, beta) = (norm.weight.val(), norm.bias.val());
        let (parameters, epsilon) = ((&weight, &gamma, &beta), norm.epsilon());
        match mode {
            Mode::Train => {
                let (out, statistics, count) = pillar_net(points, parameters, self.max_points, epsilon)?;
                norm.update(norm.moments(&statistics, count));
                Some(out)
            }
            Mode::Eval => {
                let statistics = || norm.running_statistics();
                pillar_net_inference(points, parameters, self.max_points, epsilon, statistics)
            }
        }
    }

    /// One operation a layer, and one for each appended maximum, if there are kernels.
    fn stacked(&self, rows: &PillarRows, mode: Mode) -> Option<Tensor<2>> {
        let (last, hidden) = self.pfn_layers.split_last()?;
        let (mut x, groups) = self.padded(rows);
        let groups = Arc::new(groups);
        for layer in hidden {
            let y = rows_kernel(slice::from_ref(layer), &MlpRows::Rows(x), MlpGroups::Counted(&groups), mode)?;
            x = append_maximum(&y, &groups)?; // [R, C]
        }
        rows_kernel(slice::from_ref(last), &MlpRows::Rows(x), MlpGroups::Maximum(&groups), mode)
    }

    /// The same with burn's operations.
    fn forward_on_device(&self, rows: &PillarRows, mode: Mode) -> Tensor<2> {
        let (mut x, groups) = self.padded(rows);
        let groups = groups.to_device(&x.device());
        let [rows, inputs] = x.dims();
        let filled = groups.source.len() - rows;
        x = Tensor::cat(vec![x.clone(), Tensor::zeros([filled, inputs], &x.device())], 0); // multiplicity 0
        let last = self.pfn_layers.len() - 1;
        for layer in &self.pfn_layers[..last] {
            let y = layer.forward(x, &groups.counts, mode); // [R, C / 2]
            let maximum = row_ops::gather(group_max(y.clone(), &groups), &groups.source); // [R, C / 2]
            x = Tensor::cat(vec![y, maximum], 1); // [R, C]
        }
        group_max(self.pfn_layers[last].forward(x, &groups.counts, mode), &groups) // [P, C]
    }

    /// [`PillarRows::padded`] on the device of the weights.
    fn padded(&self, rows: &PillarRows) -> (Tensor<2>, Groups) {
        let weight = self.pfn_layers[0].weight.val();
        let inputs = weight.dims()[1];
        let (features, groups) = rows.padded(inputs, self.max_points);
        let shape = [groups.source.len(), inputs];
        (Tensor::from_data(TensorData::new(features, shape), &weight.device()), groups)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layers::host;
    use burn::tensor::Device;
    use burn::tensor::activation::relu;

    const MAX_POINTS: usize = 4;
    const NUM_POINTS: [u32; 3] = [2, 4, 1];

    /// The reference's form: all rows, padding included.
    #[expect(clippy::disallowed_methods, reason = "burn's own operations are the reference")]
    fn padded_form(vfe: &PillarVfe, values: &[f32], device: &Device) -> Tensor<2> {
        let mut padded = vec![0.0f32; 3 * MAX_POINTS * 3];
        let mut from = 0;
        for (p, &count) in NUM_POINTS.iter().enumerate() {
            let count = count as usize * 3;
            padded[p * MAX_POINTS * 3..][..count].copy_from_slice(&values[from..from + count]);
            from += count;
        }
        let mut x = Tensor::<2>::from_data(TensorData::new(padded, [3 * MAX_POINTS, 3]), device);
        let mut maximum = x.clone();
        for (i, layer) in vfe.pfn_layers.iter().enumerate() {
            let y = relu(layer.norm.forward_train(x.clone().matmul(layer.weight.val().transpose())));
            let c = y.dims()[1];
            let most = y.clone().reshape([3, MAX_POINTS, c]).max_dim(1); // [P, 1, C]
            maximum = most.clone().reshape([3, c]);
            if i + 1 < vfe.pfn_layers.len() {
                let repeated = most.repeat_dim(1, MAX_POINTS).reshape([3 * MAX_POINTS, c]);
                x = Tensor::cat(vec![y, repeated], 1);
            }
        }
        maximum
    }

    /// Values, running variances and gradients by the weights of a squared sum.
    fn facts(vfe: &PillarVfe, y: Tensor<2>) -> Vec<Vec<f32>> {
        let gradients = (y.clone() * y.clone()).sum().backward();
        let mut facts = vec![host(y).unwrap()];
        for layer in &vfe.pfn_layers {
            facts.push(host(layer.norm.running_var.value()).unwrap());
            facts.push(host(layer.weight.val().grad(&gradients).unwrap()).unwrap());
            facts.push(host(layer.norm.bias.val().grad(&gradients).unwrap()).unwrap());
        }
        facts
    }

    #[test]
    fn both_forms_equal_the_padded_one() {
        let device = Device::flex().autodiff();
        let values: Vec<f32> = (0..21).map(|i| ((i * 37 % 23) as f32 - 9.0) / 5.0).collect();
        let rows = || PillarRows { features: values.clone().into(), num_points: NUM_POINTS.into() };
        for filters in [vec![5], vec![6, 5], vec![4, 8, 3]] {
            let vfe = || PillarVfe::new(3, &filters, MAX_POINTS, &Init { seed: 3, device: &device });
            let [kernel, plain, reference] = [vfe(), vfe(), vfe()];
            assert!(filters.len() == 1 || vfe().stacked(&rows(), Mode::Train).is_some());
            let want = facts(&reference, padded_form(&reference, &values, &device));
            for got in [
                facts(&kernel, kernel.forward(rows(), Mode::Train)),
                facts(&plain, plain.forward_on_device(&rows(), Mode::Train)),
            ] {
                for (got, want) in got.iter().flatten().zip(want.iter().flatten()) {
                    assert!((got - want).abs() < 2e-5 * want.abs().max(1.0), "{filters:?}: {got} {want}");
                }
            }
            let (a, b) = (kernel.valid(), plain.valid());
            let (a, b) = (a.forward(rows(), Mode::Eval), b.forward_on_device(&rows(), Mode::Eval));
            let apart: f32 = (a - b).abs().max().into_scalar();
            assert!(apart < 1e-5, "{filters:?}: {apart}");
        }
    }
}
