//! Precision of the matrix products: f32, two parts of bf16, or f16 with everything else in f32.

use crate::gpu_kernels::round_to_f16;
use burn::tensor::{Device, FloatDType, Tensor};
use std::sync::atomic::{AtomicU8, Ordering};

/// Precision of convolutions and linear layers, forward and backward. Weights, batch norms, losses and the optimiser
/// are always f32.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Precision {
    /// f32.
    #[default]
    F32,
    /// f32, with factors rounded to sums of two bf16 on GPUs whose tensor cores have bf16 (PyTorch's `high`); elsewhere
    /// as f32.
    High,
    /// f16 (mixed precision, Micikevicius et al. 2018). On tensor cores factors are rounded as they are read, which are
    /// 11 bits as in TF32; elsewhere tensors are converted.
    F16,
}

static CHOSEN: AtomicU8 = AtomicU8::new(Precision::F32 as u8);

/// Sets the choice for this process; call it before the first forward pass.
pub fn choose_precision(precision: Precision) {
    CHOSEN.store(precision as u8, Ordering::Relaxed);
}

impl Precision {
    /// The choice of this process.
    pub fn chosen() -> Precision {
        let chosen = CHOSEN.load(Ordering::Relaxed);
        [Precision::High, Precision::F16].into_iter().find(|&p| p as u8 == chosen).unwrap_or_default()
    }

    /// Whether the device supports it.
    pub fn runs_on(self, device: &Device) -> bool {
        self != Precision::F16 || device.supports_dtype(FloatDType::F16)
    }

    /// The loss scale: the loss is multiplied by it before the backward pass and the gradients are divided by it
    /// afterwards. Many gradients of dense heads are near 6e-8, the smallest f16.
    pub fn loss_scale(self) -> f64 {
        match self {
            Precision::F32 | Precision::High => 1.0,
            Precision::F16 => 1024.0,
        }
    }
}

/// `product` of two tensors in the chosen precision; the result is f32.
///
/// # Shapes
/// Those of `product`.
pub fn multiply<const A: usize, const B: usize, const C: usize>(
    a: Tensor<A>,
    b: Tensor<B>,
    product: impl FnOnce(Tensor<A>, Tensor<B>) -> Tensor<C>,
) -> Tensor<C> {
    match Precision::chosen() {
        Precision::F32 | Precision::High => product(a, b),
        Precision::F16 if round_to_f16(&a.device()) => product(a, b),
        Precision::F16 => product(a.cast(FloatDType::F16), b.cast(FloatDType::F16)).cast(FloatDType::F32),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::TensorData;

    /// The gradient of a product with respect to its first factor is the second factor. With f16 and loss scale three
    /// digits are kept, even if the unscaled gradient is below the f16 range.
    #[test]
    fn small_gradients_live() {
        let device = Device::flex().autodiff();
        let tensor = |value: f32| Tensor::<2>::from_data(TensorData::new(vec![value], [1, 1]), &device);
        let (a, b) = (tensor(0.3).require_grad(), tensor(2e-5));
        let half = |t: Tensor<2>| t.cast(FloatDType::F16);
        let product = half(a.clone()).matmul(half(b)).cast(FloatDType::F32);
        let scale = Precision::F16.loss_scale();
        let gradients = (product * 1e-3 * scale).sum().backward();
        let got: f32 = (a.grad(&gradients).unwrap() / scale).into_scalar();
        assert!((got / 2e-8 - 1.0).abs() < 5e-3, "{got}");
    }
}
