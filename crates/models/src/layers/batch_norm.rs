//! Batch normalisation with PyTorch's running statistics.
//!
//! burn's layer accumulates the biased variance of a batch; PyTorch, and thus every published checkpoint, the unbiased
//! one.

use super::{Init, Mode, RowCounts, host};
use crate::gpu_kernels;
use crate::kernel_ops::norm_relu;
use burn::module::{Module, Param, RunningState};
use burn::tensor::activation::relu;
use burn::tensor::{Tensor, TensorData};
use kernels::{Folded, NormParameters, Statistics};

/// Normalisation over all but the channel dimension, with a learned scale and shift.
#[derive(Module, Debug)]
pub struct BatchNorm {
    /// Scale, `[C]`.
    pub weight: Param<Tensor<1>>,
    /// Shift, `[C]`.
    pub bias: Param<Tensor<1>>,
    /// Running mean, `[C]`.
    pub running_mean: RunningState<Tensor<1>>,
    /// Running unbiased variance, `[C]`.
    pub running_var: RunningState<Tensor<1>>,
    /// Number of updates so far, `[1]`.
    pub num_batches_tracked: RunningState<Tensor<1>>,
    momentum: f64,
    epsilon: f64,
}

/// Statistics of a batch.
#[derive(Clone, Debug)]
pub struct Moments {
    /// Mean, `[C]`.
    pub mean: Tensor<1>,
    /// Variance with divisor n, `[C]`.
    pub variance: Tensor<1>,
    /// Number of values per channel.
    pub count: usize,
}

impl Moments {
    /// Those of the same values with `bias` added to each.
    fn shifted(self, bias: Option<Tensor<1>>) -> Self {
        match bias {
            Some(bias) => Moments { mean: self.mean.detach() + bias.detach(), ..self },
            None => self,
        }
    }
}

impl BatchNorm {
    /// Scale 1, shift 0, running mean 0 and variance 1.
    pub fn new(channels: usize, momentum: f64, epsilon: f64, init: &Init<'_>) -> Self {
        BatchNorm {
            weight: init.constant([channels], 1.0),
            bias: init.constant([channels], 0.0),
            running_mean: RunningState::new(Tensor::zeros([channels], init.device)),
            running_var: RunningState::new(Tensor::ones([channels], init.device)),
            num_batches_tracked: RunningState::new(Tensor::zeros([1], init.device)),
            momentum,
            epsilon,
        }
    }

    /// Normalises with the statistics of `x` and updates the running statistics.
    ///
    /// # Shapes
    /// `x` and result: `[B, C, ...]`.
    pub fn forward_train<const D: usize>(&self, x: Tensor<D>) -> Tensor<D> {
        self.forward_train_with_bias(x, None)
    }

    /// The same for `x` with `bias` added, which changes nothing but the running mean.
    fn forward_train_with_bias<const D: usize>(&self, x: Tensor<D>, bias: Option<Tensor<1>>) -> Tensor<D> {
        let shape = x.dims();
        let [batch, channels] = [shape[0], shape[1]];
        let values = shape[2..].iter().product();
        let count = batch * values;
        let x = x.reshape([batch, channels, values]); // [B, C, L]
        let mean = sum_per_channel(x.clone()) / count as f64; // [1, C, 1]
        let centred = x - mean.clone(); // [B, C, L]
        let variance = sum_per_channel(centred.clone().square()) / count as f64; // [1, C, 1]
        let scale = self.weight.val().reshape([1, channels, 1]) / (variance.clone() + self.epsilon).sqrt();
        let out = centred * scale + self.bias.val().reshape([1, channels, 1]); // [B, C, L]
        let moments = Moments { mean: mean.reshape([channels]), variance: variance.reshape([channels]), count };
        self.update(moments.shifted(bias));
        out.reshape(shape)
    }

    /// Normalises and applies a ReLU; in training one operation if there is a kernel. `bias` is that of the layer
    /// before and has not been added to `x`.
    ///
    /// # Shapes
    /// `x` and result: `[B, C, H, W]`; `bias`: `[C]`.
    pub fn forward_relu(&self, x: Tensor<4>, bias: Option<Tensor<1>>, mode: Mode) -> Tensor<4> {
        let channels = x.dims()[1];
        if mode == Mode::Eval {
            let x = match bias {
                Some(bias) => x + bias.reshape([1, channels, 1, 1]),
                None => x,
            };
            return relu(self.forward_eval(x));
        }
        let (weight, shift) = (self.weight.val(), self.bias.val());
        if let Some((y, moments)) = gpu_kernels::norm_relu(&x, &weight, &shift, self.epsilon, true) {
            self.update(moments.shifted(bias));
            return y;
        }
        match norm_relu(&x, &weight, &shift, self.epsilon, true) {
            Some((y, statistics)) => {
                let count = x.shape().num_elements() / channels;
                self.update(self.moments(&statistics, count).shifted(bias));
                y
            }
            None => relu(self.forward_train_with_bias(x, bias)),
        }
    }

    /// Several norms side by side as one operation, on an image that has their channels one after the other. `None`
    /// without a kernel. `biases` are those of the layers before, which have not been added to `x`.
    ///
    /// # Shapes
    /// `x` and result: `[B, sum of C, H, W]`.
    pub fn forward_relu_together(
        norms: &[&BatchNorm],
        x: &Tensor<4>,
        biases: &[Option<Tensor<1>>],
    ) -> Option<Tensor<4>> {
        let epsilon = norms.first()?.epsilon;
        let gamma = Tensor::cat(norms.iter().map(|norm| norm.weight.val()).collect(), 0);
        let beta = Tensor::cat(norms.iter().map(|norm| norm.bias.val()).collect(), 0);
        let (y, statistics) = norm_relu(x, &gamma, &beta, epsilon, true)?;
        let [batch, _, height, width] = x.dims();
        let mut from = 0;
        for (norm, bias) in norms.iter().zip(biases) {
            let own = from..from + norm.weight.val().dims()[0];
            from = own.end;
            let of = |values: &[f64]| values[own.clone()].to_vec();
            let own = Statistics { mean: of(&statistics.mean), variance: of(&statistics.variance) };
            norm.update(norm.moments(&own, batch * height * width).shifted(bias.clone()));
        }
        Some(y)
    }

    /// Statistics of a batch from host values.
    pub fn moments(&self, statistics: &Statistics, count: usize) -> Moments {
        let device = self.running_mean.value().device();
        let tensor = |values: &[f64]| {
            let values: Vec<f32> = values.iter().map(|&v| v as f32).collect();
            Tensor::from_data(TensorData::new(values, [statistics.mean.len()]), &device)
        };
        Moments { mean: tensor(&statistics.mean), variance: tensor(&statistics.variance), count }
    }

    /// The running statistics on the host.
    ///
    /// # Panics
    /// When they are not f32.
    pub fn running_statistics(&self) -> Statistics {
        let of = |state: &RunningState<Tensor<1>>| {
            host(state.value()).expect("statistics are f32").into_iter().map(f64::from).collect()
        };
        Statistics { mean: of(&self.running_mean), variance: of(&self.running_var) }
    }

    /// Applies `fold` to this norm with its running statistics, to fold it into the weights of the preceding layer,
    /// whose bias is `bias`.
    ///
    /// # Panics
    /// When the parameters are not f32.
    pub fn folded(&self, bias: Option<Tensor<1>>, fold: impl FnOnce(&NormParameters<'_>) -> Folded) -> Folded {
        let [gamma, beta] = [&self.weight, &self.bias].map(|p| host(p.val()).expect("parameters are f32"));
        let mut statistics = self.running_statistics();
        let bias = bias.map_or_else(Vec::new, |bias| host(bias).expect("parameters are f32"));
        for (mean, bias) in statistics.mean.iter_mut().zip(bias) {
            *mean -= f64::from(bias);
        }
        fold(&NormParameters { gamma: &gamma, beta: &beta, statistics: &statistics, epsilon: self.epsilon })
    }

    /// Added to the variance before its square root.
    pub fn epsilon(&self) -> f64 {
        self.epsilon
    }

    /// Normalises with the running statistics.
    ///
    /// # Shapes
    /// `x` and result: `[B, C, ...]`.
    pub fn forward_eval<const D: usize>(&self, x: Tensor<D>) -> Tensor<D> {
        let (mean, variance) = (self.running_mean.value(), self.running_var.value());
        burn::tensor::module::batch_norm(x, self.weight.val(), self.bias.val(), mean, variance, self.epsilon)
    }

    /// Normalises rows with given statistics, which stay in the autodiff graph.
    ///
    /// # Shapes
    /// `x` and result: `[N, C]`.
    pub fn normalise_rows(&self, x: Tensor<2>, moments: &Moments) -> Tensor<2> {
        let scale = self.weight.val() / (moments.variance.clone() + self.epsilon).sqrt(); // [C]
        (x - moments.mean.clone().unsqueeze::<2>()) * scale.unsqueeze() + self.bias.val().unsqueeze() // [N, C]
    }

    /// Normalises rows with their statistics and updates the running statistics.
    ///
    /// # Shapes
    /// `x` and result: `[N, C]`.
    pub fn forward_rows_train(&self, x: Tensor<2>, counts: &RowCounts) -> Tensor<2> {
        let channels = x.dims()[1];
        let mean = counts.mean(x.clone()); // [1, C]
        let centered = x - mean.clone(); // [N, C]
        let variance = counts.mean(centered.clone() * centered.clone()); // [1, C]
        let scale = self.weight.val().unsqueeze() / (variance.clone() + self.epsilon).sqrt(); // [1, C]
        let (mean, variance) = (mean.reshape([channels]), variance.reshape([channels]));
        self.update(Moments { mean, variance, count: counts.total() });
        centered * scale + self.bias.val().unsqueeze()
    }

    /// The same with a ReLU.
    pub fn forward_rows_relu_train(&self, x: Tensor<2>, counts: &RowCounts) -> Tensor<2> {
        let (weight, bias, of_rows) = (self.weight.val(), self.bias.val(), counts.values());
        let of_rows = (&of_rows, counts.total());
        match gpu_kernels::norm_relu_rows(&x, (&weight, &bias), of_rows, self.epsilon, true) {
            Some((y, moments)) => {
                self.update(moments);
                y
            }
            None => relu(self.forward_rows_train(x, counts)),
        }
    }

    /// Normalises rows with the running statistics.
    ///
    /// # Shapes
    /// `x` and result: `[N, C]`.
    pub fn forward_rows_eval(&self, x: Tensor<2>) -> Tensor<2> {
        let scale = self.weight.val() / (self.running_var.value() + self.epsilon).sqrt(); // [C]
        let shift = self.bias.val() - self.running_mean.value() * scale.clone(); // [C]
        x * scale.unsqueeze() + shift.unsqueeze()
    }

    /// The running statistics for [`BatchNorm::normalise_rows`].
    pub fn running(&self) -> Moments {
        Moments { mean: self.running_mean.value(), variance: self.running_var.value(), count: 0 }
    }

    /// Updates the running statistics with those of a batch, outside the autodiff graph.
    pub fn update(&self, batch: Moments) {
        let n = batch.count as f64;
        let unbiased = n / (n - 1.0).max(1.0);
        let (mean, variance) = (batch.mean.detach(), batch.variance.detach());
        let states = [&self.running_mean, &self.running_var];
        let old = states.map(|state| state.value());
        let [old_mean, old_variance] = &old;
        let blended = gpu_kernels::blend([old_mean, old_variance], [&mean, &variance], self.momentum, unbiased);
        let blended = blended.unwrap_or_else(|| {
            let blend = |old: &Tensor<1>, new: Tensor<1>| old.clone() * (1.0 - self.momentum) + new * self.momentum;
            [blend(old_mean, mean), blend(old_variance, variance * unbiased)]
        });
        for (state, new) in states.into_iter().zip(blended) {
            state.update(new);
            state.value_sync();
        }
        self.num_batches_tracked.update(self.num_batches_tracked.value() + 1.0);
        self.num_batches_tracked.value_sync();
    }
}

/// Sum over all but the channels, first within groups, because a sequential f32 sum over tens of thousands of values
/// loses precision.
///
/// # Shapes
/// `x`: `[B, C, L]`; result `[1, C, 1]`.
fn sum_per_channel(x: Tensor<3>) -> Tensor<3> {
    const LARGEST_GROUP: usize = 256;
    let [batch, channels, values] = x.dims();
    let group = (1..=LARGEST_GROUP).rev().find(|group| values % group == 0).unwrap_or(1);
    let sums = x.reshape([batch, channels, values / group, group]).sum_dim(3); // [B, C, L / G, 1]
    sums.sum_dim(2).sum_dim(0).reshape([1, channels, 1])
}
