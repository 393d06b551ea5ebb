//! In which floats the layers multiply: all single, or products in half precision and everything else in single.

use burn::tensor::{Device, FloatDType, Tensor};
use std::sync::atomic::{AtomicBool, Ordering};

/// What convolutions and linear layers multiply, forward and backward. Weights, batch norms, losses and the optimiser are f32 in both.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Precision {
    /// 24 bits of mantissa.
    #[default]
    F32,
    /// 11 bits: half of the memory traffic, and a GPU's matrix units where burn uses them. "Mixed precision" (Micikevicius et al. 2018).
    F16,
}

static HALF: AtomicBool = AtomicBool::new(false);

/// Chooses for this process, before the first network computes.
pub fn choose_precision(precision: Precision) {
    HALF.store(precision == Precision::F16, Ordering::Relaxed);
}

impl Precision {
    /// The choice that holds.
    pub fn chosen() -> Precision {
        if HALF.load(Ordering::Relaxed) { Precision::F16 } else { Precision::F32 }
    }

    /// Whether the device computes in it.
    pub fn runs_on(self, device: &Device) -> bool {
        self == Precision::F32 || device.supports_dtype(FloatDType::F16)
    }

    /// What the loss is multiplied with before its gradient is taken, and the gradients divided by afterwards: f16 ends at 6e-8, where many
    /// gradients of an image of anchors lie.
    pub fn loss_scale(self) -> f64 {
        match self {
            Precision::F32 => 1.0,
            Precision::F16 => 1024.0,
        }
    }
}

/// `product` of two tensors in the precision that was chosen; the result is f32.
///
/// # Shapes
/// As `product` has them.
pub fn multiply<const A: usize, const B: usize, const C: usize>(
    a: Tensor<A>,
    b: Tensor<B>,
    product: impl FnOnce(Tensor<A>, Tensor<B>) -> Tensor<C>,
) -> Tensor<C> {
    match Precision::chosen() {
        Precision::F32 => product(a, b),
        Precision::F16 => product(a.cast(FloatDType::F16), b.cast(FloatDType::F16)).cast(FloatDType::F32),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::TensorData;

    /// The gradient of a product by its first factor is the second: in half precision with its loss scale three digits of it are kept,
    /// also where it lies below what f16 can hold.
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
