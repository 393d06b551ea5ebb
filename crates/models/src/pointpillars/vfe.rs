//! Pillar feature net (OpenPCDet: `PillarVFE`).

use crate::kernel_ops::{pillar_net, pillar_net_inference};
use crate::layers::{BatchNorm, Init, Mode, Moments};
use burn::module::{Module, Param};
use burn::tensor::activation::relu;
use burn::tensor::{Int, Tensor, TensorData};
use std::sync::Arc;

/// Linear without bias, batch normalisation, ReLU, maximum over the pillar.
///
/// The reference pads every pillar with zero rows up to `max_points` *before* the linear layer. These rows count in the
/// statistics and in the maximum. Here only the points are computed. A zero row is zero after the linear layer, so its
/// contribution to mean and variance is known, and one row represents all of them in the maximum.
#[derive(Module, Debug)]
pub struct PillarVfe {
    /// `[C, F]`, F = 10 with intensity, 9 without.
    pub weight: Param<Tensor<2>>,
    /// The batch norm after the linear layer.
    pub norm: BatchNorm,
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

impl PillarVfe {
    /// For `inputs` values a point and `filters` values a pillar.
    pub fn new(inputs: usize, filters: usize, max_points: usize, init: &Init<'_>) -> Self {
        PillarVfe {
            weight: init.uniform("vfe.pfn_layers.0.linear.weight", [filters, inputs], inputs),
            norm: BatchNorm::new(filters, 0.01, 1e-3, init),
            max_points,
        }
    }

    /// # Shapes
    /// `rows.features`: `[N, F]`; result `[P, C]`.
    pub fn forward(&self, rows: PillarRows, mode: Mode) -> Tensor<2> {
        let points = (rows.features.clone(), rows.num_points.clone());
        let (weight, gamma, beta) = (self.weight.val(), self.norm.weight.val(), self.norm.bias.val());
        let (parameters, epsilon) = ((&weight, &gamma, &beta), self.norm.epsilon());
        match mode {
            Mode::Train => match pillar_net(points, parameters, self.max_points, epsilon) {
                Some((out, statistics, count)) => {
                    self.norm.update(self.norm.moments(&statistics, count));
                    out
                }
                None => self.forward_on_device(rows, mode),
            },
            Mode::Eval => {
                let statistics = || self.norm.running_statistics();
                pillar_net_inference(points, parameters, self.max_points, epsilon, statistics)
                    .unwrap_or_else(|| self.forward_on_device(rows, mode))
            }
        }
    }

    /// The same with burn's operations.
    fn forward_on_device(&self, rows: PillarRows, mode: Mode) -> Tensor<2> {
        let weight = self.weight.val();
        let device = weight.device();
        let inputs = weight.dims()[1];
        let n = rows.features.len() / inputs;
        let features = Tensor::<2>::from_data(TensorData::new(rows.features.to_vec(), [n, inputs]), &device); // [N, F]
        let pillars = rows.num_points.len();
        let x = features.matmul(weight.transpose()); // [N, C]
        let [_, c] = x.dims();
        let moments = match mode {
            Mode::Train => {
                let moments = padded_moments(x.clone(), pillars * self.max_points);
                self.norm.update(moments.clone());
                moments
            }
            Mode::Eval => self.norm.running(),
        };
        let x = Tensor::cat(vec![x, Tensor::zeros([1, c], &device)], 0); // [N + 1, C]; the last row is the padding
        let x = relu(self.norm.normalise_rows(x, &moments)); // [N + 1, C]
        let (slots, index) = slot_index(&rows.num_points, self.max_points, n);
        let index = Tensor::<1, Int>::from_data(TensorData::new(index, [pillars * slots]), &device);
        x.select(0, index).reshape([pillars, slots, c]).max_dim(1).reshape([pillars, c]) // [P, S, C] -> [P, C]
    }
}

/// Mean and variance over `count` rows, of which those not in `x` are zero.
fn padded_moments(x: Tensor<2>, count: usize) -> Moments {
    let [n, c] = x.dims();
    let rows = count as f64;
    let mean = sum_rows(x.clone()) / rows; // [1, C]
    let deviation = sum_rows((x - mean.clone()).powi_scalar(2)); // [1, C]
    let variance = (deviation + mean.clone().powi_scalar(2) * (count - n) as f64) / rows;
    Moments { mean: mean.reshape([c]), variance: variance.reshape([c]), count }
}

/// Sum over the rows, first within groups of 64, because a sequential f32 sum over tens of thousands of rows loses
/// precision.
///
/// # Shapes
/// `x`: `[N, C]`; result `[1, C]`.
fn sum_rows(x: Tensor<2>) -> Tensor<2> {
    const GROUP: usize = 64;
    let [n, c] = x.dims();
    let groups = n.div_ceil(GROUP);
    let filled = Tensor::cat(vec![x.clone(), Tensor::zeros([groups * GROUP - n, c], &x.device())], 0);
    filled.reshape([groups, GROUP, c]).sum_dim(1).reshape([groups, c]).sum_dim(0) // [G, 64, C] -> [G, C] -> [1, C]
}

/// For each pillar the rows of its points, padded with the row `padding`. The number of slots is that of the fullest
/// pillar, plus one for the padding if it has fewer than `max_points` points.
fn slot_index(num_points: &[u32], max_points: usize, padding: usize) -> (usize, Vec<i32>) {
    let fullest = num_points.iter().max().copied().unwrap_or(0) as usize;
    let slots = (fullest + 1).min(max_points);
    let mut index = Vec::with_capacity(num_points.len() * slots);
    let mut row = 0;
    for &count in num_points {
        index.extend((0..slots).map(|s| if s < count as usize { row + s as i32 } else { padding as i32 }));
        row += count as i32;
    }
    (slots, index)
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::Device;

    #[test]
    fn equals_the_padded_form() {
        let device = Device::flex();
        let vfe = PillarVfe::new(3, 5, 4, &Init { seed: 3, device: &device });
        let (num_points, max_points) = (vec![2u32, 4, 1], 4);
        let values: Vec<f32> = (0..21).map(|i| ((i * 37 % 23) as f32 - 9.0) / 5.0).collect();
        let rows = || PillarRows { features: values.clone().into(), num_points: num_points.clone().into() };
        let got = vfe.forward(rows(), Mode::Train);
        let other = PillarVfe::new(3, 5, 4, &Init { seed: 3, device: &device });
        let on_device = other.forward_on_device(rows(), Mode::Train);

        let mut padded = vec![0.0f32; 3 * max_points * 3];
        let mut from = 0;
        for (p, &count) in num_points.iter().enumerate() {
            let count = count as usize * 3;
            padded[p * max_points * 3..][..count].copy_from_slice(&values[from..from + count]);
            from += count;
        }
        let fresh = PillarVfe::new(3, 5, 4, &Init { seed: 3, device: &device });
        let x =
            Tensor::<2>::from_data(TensorData::new(padded, [12, 3]), &device).matmul(fresh.weight.val().transpose());
        let want = relu(fresh.norm.forward_train(x)).reshape([3, 4, 5]).max_dim(1).reshape([3, 5]);
        for got in [got, on_device] {
            let difference: f32 = (got - want.clone()).abs().max().into_scalar();
            assert!(difference < 1e-5, "{difference}");
        }
        let statistics = |v: &PillarVfe| crate::layers::host(v.norm.running_var.value()).unwrap();
        for (a, b) in statistics(&vfe).iter().zip(statistics(&fresh)) {
            assert!((a - b).abs() < 1e-6, "{a} {b}");
        }
    }
}
