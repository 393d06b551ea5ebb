//! Layers over rows, where a row is a point or a point of a group: linear layers and 1x1 convolutions of PyTorch.

use super::precision::multiply;
use super::{BatchNorm, Init, Mode};
use crate::kernel_ops::{MlpGroups, MlpParameters, MlpRows, shared_mlp, shared_mlp_inference};
use crate::products;
use burn::module::{Module, Param};
use burn::tensor::activation::relu;
use burn::tensor::{Device, Tensor, TensorData};

/// Largest number of terms of a sequential sum: a sequential f32 sum over tens of thousands of rows would lose
/// precision.
const BLOCK: usize = 16;

/// Rows are padded to a multiple of this, so that they divide into blocks.
const FILL: usize = BLOCK * BLOCK;

/// Multiplicity of each row in batch statistics: rows that the reference repeats are computed once.
#[derive(Clone, Debug)]
pub struct RowCounts {
    /// In blocks of equal length, `[N / K, 1, K]`.
    counts: Tensor<3>,
    /// Their sum.
    total: usize,
}

impl RowCounts {
    /// From one count per row.
    pub fn new(counts: Vec<f32>, device: &Device) -> Self {
        let n = counts.len();
        let total = counts.iter().map(|&c| f64::from(c)).sum::<f64>() as usize;
        let length = block(n);
        RowCounts { counts: Tensor::from_data(TensorData::new(counts, [n / length, 1, length]), device), total }
    }

    /// Multiplicity 1 for each of `rows` rows.
    pub fn once(rows: usize, device: &Device) -> Self {
        RowCounts::new(vec![1.0; rows], device)
    }

    /// The padded number of rows; padding rows have multiplicity 0.
    pub fn filled_up(rows: usize) -> usize {
        rows.next_multiple_of(FILL)
    }

    /// The multiplicity of each row, `[N]`.
    pub fn values(&self) -> Tensor<1> {
        self.counts.clone().reshape([-1])
    }

    /// Sum of the counts.
    pub fn total(&self) -> usize {
        self.total
    }

    /// Mean over the rows, weighted by multiplicity.
    ///
    /// # Shapes
    /// `x`: `[N, C]`; result `[1, C]`.
    pub fn mean(&self, x: Tensor<2>) -> Tensor<2> {
        let ([mut blocks, _, length], [_, channels]) = (self.counts.dims(), x.dims());
        let mut sums = self.counts.clone().matmul(x.reshape([blocks, length, channels])); // [N / K, 1, C]
        while blocks > 1 {
            let length = if block(blocks) > 1 { block(blocks) } else { blocks };
            blocks /= length;
            sums = sums.reshape([blocks, length, channels]).sum_dim(1); // [blocks, 1, C]
        }
        sums.reshape([1, channels]) / self.total.max(1) as f64
    }
}

/// The largest divisor of `n` up to [`BLOCK`].
fn block(n: usize) -> usize {
    (1..=BLOCK.min(n)).rev().find(|length| n.is_multiple_of(*length)).unwrap_or(1)
}

/// Linear layer without bias, batch normalisation, ReLU. `D` is the number of dimensions of the weight in the
/// reference.
#[derive(Module, Debug)]
pub struct RowsBnRelu<const D: usize> {
    /// `[C_out, C_in, 1, ..]`.
    pub weight: Param<Tensor<D>>,
    /// The batch norm after the linear layer.
    pub norm: BatchNorm,
}

impl<const D: usize> RowsBnRelu<D> {
    /// A layer of the given channels with PyTorch's default weights; `name` keys them.
    pub fn new(name: &str, channels: [usize; 2], norm: BatchNorm, init: &Init<'_>) -> Self {
        RowsBnRelu { weight: init.uniform(name, stored(channels), channels[0]), norm }
    }

    /// The same with Xavier's normal weights (Glorot and Bengio 2010).
    pub fn xavier(name: &str, channels: [usize; 2], norm: BatchNorm, init: &Init<'_>) -> Self {
        RowsBnRelu { weight: init.xavier_normal(name, stored(channels), channels), norm }
    }

    /// The linear part for the `x.dims()[1]` input channels from `first` on. A linear layer over concatenated channels
    /// is the sum of linear layers over the parts, so each part can be computed where it has the fewest rows.
    ///
    /// # Shapes
    /// `x`: `[N, K]`; result `[N, C_out]`.
    pub fn project(&self, x: Tensor<2>, first: usize) -> Tensor<2> {
        project(&self.weight, x, first)
    }

    /// Batch norm and ReLU after the linear part.
    ///
    /// # Shapes
    /// `y` and result: `[N, C_out]`.
    pub fn norm_relu(&self, y: Tensor<2>, counts: &RowCounts, mode: Mode) -> Tensor<2> {
        match mode {
            Mode::Train => self.norm.forward_rows_relu_train(y, counts),
            Mode::Eval => relu(self.norm.forward_rows_eval(y)),
        }
    }

    /// # Shapes
    /// `x`: `[N, C_in]`; result `[N, C_out]`.
    pub fn forward(&self, x: Tensor<2>, counts: &RowCounts, mode: Mode) -> Tensor<2> {
        self.norm_relu(self.project(x, 0), counts, mode)
    }
}

/// Consecutive layers and the maximum over groups as one operation; `None` without a kernel.
///
/// # Shapes
/// `rows`: see [`MlpRows`]; result `[G, C]`, or `[N, C]` without a maximum.
pub fn rows_kernel<'a, const D: usize>(
    layers: &[RowsBnRelu<D>],
    rows: &MlpRows,
    groups: impl Into<MlpGroups<'a>>,
    mode: Mode,
) -> Option<Tensor<2>> {
    let first_columns = if matches!(rows, MlpRows::Gathered(_)) { 3 } else { usize::MAX };
    let parameters = |(l, layer): (usize, &RowsBnRelu<D>)| {
        let weight = matrix(&layer.weight);
        let columns = if l == 0 { weight.dims()[1].min(first_columns) } else { weight.dims()[1] };
        let weight = weight.narrow(1, 0, columns);
        MlpParameters { weight, gamma: layer.norm.weight.val(), beta: layer.norm.bias.val() }
    };
    let parameters: Vec<_> = layers.iter().enumerate().map(parameters).collect();
    let epsilon = layers.first()?.norm.epsilon();
    let groups = groups.into();
    match mode {
        Mode::Train => {
            let (out, statistics, count) = shared_mlp(rows, groups, &parameters, epsilon)?;
            for (layer, statistics) in layers.iter().zip(&statistics) {
                layer.norm.update(layer.norm.moments(statistics, count));
            }
            Some(out)
        }
        Mode::Eval => {
            let statistics = || layers.iter().map(|layer| layer.norm.running_statistics()).collect();
            shared_mlp_inference(rows, groups, &parameters, epsilon, statistics)
        }
    }
}

/// Linear layer with bias.
#[derive(Module, Debug)]
pub struct RowsLinear<const D: usize> {
    /// `[C_out, C_in, 1, ..]`.
    pub weight: Param<Tensor<D>>,
    /// `[C_out]`.
    pub bias: Param<Tensor<1>>,
}

impl<const D: usize> RowsLinear<D> {
    /// PyTorch's default weights and biases; `name` keys them.
    pub fn new(name: &str, channels: [usize; 2], init: &Init<'_>) -> Self {
        RowsLinear {
            weight: init.uniform(&format!("{name}.weight"), stored(channels), channels[0]),
            bias: init.uniform(&format!("{name}.bias"), [channels[1]], channels[0]),
        }
    }

    /// Xavier's normal weights and biases of zero.
    pub fn xavier(name: &str, channels: [usize; 2], init: &Init<'_>) -> Self {
        RowsLinear {
            weight: init.xavier_normal(&format!("{name}.weight"), stored(channels), channels),
            bias: init.constant([channels[1]], 0.0),
        }
    }

    /// As [`RowsBnRelu::project`].
    ///
    /// # Shapes
    /// `x`: `[N, K]`; result `[N, C_out]`.
    pub fn project(&self, x: Tensor<2>, first: usize) -> Tensor<2> {
        project(&self.weight, x, first)
    }

    /// # Shapes
    /// `x`: `[N, C_in]`; result `[N, C_out]`.
    pub fn forward(&self, x: Tensor<2>) -> Tensor<2> {
        let (y, bias) = (self.project(x, 0), self.bias.val());
        if products::are_used_on(&y.device()) { products::add_to_rows(y, bias) } else { y + bias.unsqueeze() }
    }
}

fn stored<const D: usize>([input, output]: [usize; 2]) -> [usize; D] {
    std::array::from_fn(|i| match i {
        0 => output,
        1 => input,
        _ => 1,
    })
}

/// `[C_out, C_in]`.
fn matrix<const D: usize>(weight: &Param<Tensor<D>>) -> Tensor<2> {
    let dims = weight.dims();
    weight.val().reshape([dims[0], dims[1]])
}

fn project<const D: usize>(weight: &Param<Tensor<D>>, x: Tensor<2>, first: usize) -> Tensor<2> {
    let (matrix, columns) = (matrix(weight), x.dims()[1]);
    let matrix = if columns == matrix.dims()[1] { matrix } else { matrix.narrow(1, first, columns) };
    if products::are_used_on(&x.device()) {
        return multiply(x, matrix, products::rows_by);
    }
    multiply(x, matrix.transpose(), Tensor::matmul)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layers::host;
    use crate::row_ops;

    fn tensor(values: &[f32], shape: [usize; 2], device: &Device) -> Tensor<2> {
        Tensor::from_data(TensorData::new(values.to_vec(), shape), device)
    }

    fn layer(device: &Device) -> RowsBnRelu<4> {
        let init = Init { seed: 5, device };
        RowsBnRelu::new("layer", [3, 4], BatchNorm::new(4, 0.1, 1e-5, &init), &init)
    }

    /// Values, gradient with respect to the weight, and running variance.
    fn run(rows: &[f32], counts: RowCounts, pick: &[u32], device: &Device) -> [Vec<f32>; 3] {
        let layer = layer(device);
        let x = tensor(rows, [rows.len() / 3, 3], device);
        let y = row_ops::gather(layer.forward(x, &counts, Mode::Train), &pick.into());
        let gradients = (y.clone() * y.clone()).sum().backward();
        let gradient = layer.weight.val().grad(&gradients).unwrap();
        [host(y).unwrap(), host(gradient).unwrap(), host(layer.norm.running_var.value()).unwrap()]
    }

    #[test]
    fn multiplicity_3_equals_three_rows() {
        let device = Device::flex().autodiff();
        let rows: Vec<f32> = (0..12).map(|i| ((i * 29 % 17) as f32 - 8.0) / 4.0).collect();
        let counts = [1usize, 3, 2, 1];
        let repeated: Vec<f32> = (0..4).flat_map(|r| rows[r * 3..r * 3 + 3].repeat(counts[r])).collect();
        let once = run(&rows, RowCounts::new(vec![1.0, 3.0, 2.0, 1.0], &device), &[0, 1, 1, 1, 2, 2, 3], &device);
        let plain = run(&repeated, RowCounts::once(7, &device), &[0, 1, 2, 3, 4, 5, 6], &device);
        for (a, b) in once.iter().zip(&plain) {
            assert!(a.len() == b.len() && a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-5), "{a:?} {b:?}");
        }
    }

    #[test]
    fn means_of_any_number_of_rows() {
        let device = Device::flex();
        for rows in [1usize, 2, 17, 97, 256, 1000, 4099, 70_000] {
            let values: Vec<f32> = (0..rows).map(|i| 1.0 + (i % 7) as f32).collect();
            let counts: Vec<f32> = (0..rows).map(|i| (i % 3) as f32 + 1.0).collect();
            let both = || values.iter().zip(&counts).map(|(&v, &c)| (f64::from(v), f64::from(c)));
            let want = both().map(|(v, c)| v * c).sum::<f64>() / both().map(|(_, c)| c).sum::<f64>();
            let mean = RowCounts::new(counts.clone(), &device).mean(tensor(&values, [rows, 1], &device));
            assert!((f64::from(host(mean).unwrap()[0]) / want - 1.0).abs() < 1e-6, "{rows}");
        }
    }

    #[test]
    fn parts_add_up() {
        let device = Device::flex();
        let layer = layer(&device);
        let x = tensor(&[0.3, -1.0, 2.0, 0.7, 0.1, -0.4], [2, 3], &device);
        let whole = layer.project(x.clone(), 0);
        let parts = layer.project(x.clone().narrow(1, 0, 1), 0) + layer.project(x.narrow(1, 1, 2), 1);
        let difference: f32 = (whole - parts).abs().max().into_scalar();
        assert!(difference < 1e-6, "{difference}");
    }
}
