//! Initial weights from a named stream of random numbers, the same on every device.

use burn::module::Param;
use burn::tensor::{Device, Tensor, TensorData};
use data::stream;
use rand::RngExt;

/// Source of initial weights: each tensor has a random stream keyed by seed and name.
#[derive(Clone, Copy, Debug)]
pub struct Init<'a> {
    /// Seed of the run.
    pub seed: u64,
    /// Device of the tensors.
    pub device: &'a Device,
}

impl Init<'_> {
    /// All elements equal.
    pub fn constant<const D: usize>(&self, shape: [usize; D], value: f32) -> Param<Tensor<D>> {
        Param::from_tensor(Tensor::full(shape, value, self.device))
    }

    /// Uniform in `±1/sqrt(fan_in)`: PyTorch's default for linear layers and convolutions (Kaiming uniform with a =
    /// sqrt 5).
    pub fn uniform<const D: usize>(&self, name: &str, shape: [usize; D], fan_in: usize) -> Param<Tensor<D>> {
        let bound = 1.0 / (fan_in as f32).sqrt();
        self.draw(name, shape, |random| (2.0 * random() - 1.0) * bound)
    }

    /// Normal with mean 0 (Box-Muller).
    pub fn normal<const D: usize>(&self, name: &str, shape: [usize; D], deviation: f32) -> Param<Tensor<D>> {
        self.draw(name, shape, |random| {
            let radius = (-2.0 * (1.0 - random()).ln()).sqrt();
            radius * (std::f32::consts::TAU * random()).cos() * deviation
        })
    }

    /// Normal with variance `2 / (fan_in + fan_out)` (Glorot and Bengio 2010): PyTorch's `xavier_normal_`.
    pub fn xavier_normal<const D: usize>(&self, name: &str, shape: [usize; D], fans: [usize; 2]) -> Param<Tensor<D>> {
        self.normal(name, shape, (2.0 / (fans[0] + fans[1]) as f32).sqrt())
    }

    fn draw<const D: usize>(
        &self,
        name: &str,
        shape: [usize; D],
        mut value: impl FnMut(&mut dyn FnMut() -> f32) -> f32,
    ) -> Param<Tensor<D>> {
        let mut stream = stream(self.seed, &format!("weights/{name}"), 0, 0);
        let mut random = || stream.random::<f32>();
        let values: Vec<f32> = (0..shape.iter().product()).map(|_| value(&mut random)).collect();
        Param::from_tensor(Tensor::from_data(TensorData::new(values, shape), self.device))
    }
}
