//! The kernels of the crate `kernels` as operations of burn's flex backend, with their gradients.
//!
//! Each function returns `None` where there is no kernel: on another device, for other shapes, or when burn's own operations are asked for.
//! Whoever calls it does the same with burn then.

mod batch_norm;
mod convolution;
mod focal_loss;
mod operation;
mod pillar_net;
mod shared_mlp;

pub use batch_norm::batch_norm_relu;
pub use convolution::{conv_transpose, conv3x3, pointwise};
pub use focal_loss::focal_loss_sum;
pub use pillar_net::pillar_net;
pub use shared_mlp::{MlpRows, MlpTensors, shared_mlp};

use crate::layers::Moments;
use burn::tensor::{Device, Tensor, TensorData};
use kernels::{Algorithm, Statistics};
use std::sync::atomic::{AtomicU8, Ordering};

/// Which operations run on the CPU.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Kernels {
    /// Those of the crate `kernels` where there are any, with F(2x2, 3x3).
    #[default]
    Auto,
    /// The same with F(4x4, 3x3): a little faster, a digit less exact.
    Fast,
    /// burn's own.
    Burn,
}

static CHOSEN: AtomicU8 = AtomicU8::new(0);

/// Chooses for the whole program; to be called before the first step.
pub fn choose(kernels: Kernels) {
    CHOSEN.store(kernels as u8, Ordering::Relaxed);
}

/// What [`choose`] chose.
pub fn chosen() -> Kernels {
    match CHOSEN.load(Ordering::Relaxed) {
        0 => Kernels::Auto,
        1 => Kernels::Fast,
        _ => Kernels::Burn,
    }
}

/// The algorithm of the 3x3 convolutions; `None` when no kernel is wanted.
fn algorithm() -> Option<Algorithm> {
    match chosen() {
        Kernels::Auto => Some(Algorithm::WinogradF2),
        Kernels::Fast => Some(Algorithm::WinogradF4),
        Kernels::Burn => None,
    }
}

/// Statistics for the running ones.
fn moments(statistics: &Statistics, count: usize, device: &Device) -> Moments {
    let tensor = |values: &[f64]| {
        let values: Vec<f32> = values.iter().map(|&v| v as f32).collect();
        let n = values.len();
        Tensor::<1>::from_data(TensorData::new(values, [n]), device)
    };
    Moments { mean: tensor(&statistics.mean), variance: tensor(&statistics.variance), count }
}
