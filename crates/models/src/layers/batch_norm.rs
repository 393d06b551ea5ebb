//! Batch normalisation with PyTorch's running statistics.
//!
//! burn's own layer keeps the biased variance of a batch; PyTorch, and so every published checkpoint, the unbiased one.

use super::{Init, RowCounts};
use burn::module::{Module, Param, RunningState};
use burn::tensor::Tensor;

/// Normalisation over all but the channel dimension, with a learned scale and shift.
#[derive(Module, Debug)]
pub struct BatchNorm {
    /// Scale, `[C]`.
    pub weight: Param<Tensor<1>>,
    /// Shift, `[C]`.
    pub bias: Param<Tensor<1>>,
    /// Mean over past batches, `[C]`.
    pub running_mean: RunningState<Tensor<1>>,
    /// Unbiased variance over past batches, `[C]`.
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
    /// Number of values a channel.
    pub count: usize,
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

    /// Normalises with the statistics of `x` and takes them into the running ones.
    ///
    /// # Shapes
    /// `x`: `[B, C, ...]`, the result alike.
    pub fn forward_train<const D: usize>(&self, x: Tensor<D>) -> Tensor<D> {
        let channels = x.dims()[1];
        let count = x.shape().num_elements() / channels;
        let out = burn::tensor::module::batch_norm_train(x, self.weight.val(), self.bias.val(), self.epsilon);
        self.update(Moments { mean: out.mean, variance: out.variance, count });
        out.output
    }

    /// Normalises with the running statistics.
    ///
    /// # Shapes
    /// `x`: `[B, C, ...]`, the result alike.
    pub fn forward_eval<const D: usize>(&self, x: Tensor<D>) -> Tensor<D> {
        let (mean, variance) = (self.running_mean.value(), self.running_var.value());
        burn::tensor::module::batch_norm(x, self.weight.val(), self.bias.val(), mean, variance, self.epsilon)
    }

    /// Normalises rows with given statistics, which stay in the graph.
    ///
    /// # Shapes
    /// `x`: `[N, C]`, the result alike.
    pub fn normalise_rows(&self, x: Tensor<2>, moments: &Moments) -> Tensor<2> {
        let scale = self.weight.val() / (moments.variance.clone() + self.epsilon).sqrt(); // [C]
        (x - moments.mean.clone().unsqueeze::<2>()) * scale.unsqueeze() + self.bias.val().unsqueeze() // [N, C]
    }

    /// Normalises rows with their own statistics and takes these into the running ones.
    ///
    /// # Shapes
    /// `x`: `[N, C]`, the result alike.
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

    /// Normalises rows with the running statistics.
    ///
    /// # Shapes
    /// `x`: `[N, C]`, the result alike.
    pub fn forward_rows_eval(&self, x: Tensor<2>) -> Tensor<2> {
        let scale = self.weight.val() / (self.running_var.value() + self.epsilon).sqrt(); // [C]
        let shift = self.bias.val() - self.running_mean.value() * scale.clone(); // [C]
        x * scale.unsqueeze() + shift.unsqueeze()
    }

    /// The statistics of past batches, as [`BatchNorm::normalise_rows`] takes them.
    pub fn running(&self) -> Moments {
        Moments { mean: self.running_mean.value(), variance: self.running_var.value(), count: 0 }
    }

    /// Takes the statistics of a batch into the running ones; nothing of it enters the graph.
    pub fn update(&self, batch: Moments) {
        let n = batch.count as f64;
        let unbiased = batch.variance.detach() * (n / (n - 1.0).max(1.0));
        let blend = |state: &RunningState<Tensor<1>>, new: Tensor<1>| {
            state.update(state.value() * (1.0 - self.momentum) + new * self.momentum);
            state.value_sync();
        };
        blend(&self.running_mean, batch.mean.detach());
        blend(&self.running_var, unbiased);
        self.num_batches_tracked.update(self.num_batches_tracked.value() + 1.0);
        self.num_batches_tracked.value_sync();
    }
}
