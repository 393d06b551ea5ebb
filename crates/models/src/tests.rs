//! What tests of operations share: the devices of this build and this machine, and numbers that are the same on each.

use burn::tensor::{Device, Tensor, TensorData};
use rand::RngExt;

/// The devices with their names.
pub fn devices() -> Vec<(&'static str, Device)> {
    #[expect(deprecated, reason = "kept as long as burn has it")]
    let ndarray = Device::ndarray();
    let cpus = [("flex", Device::flex()), ("ndarray", ndarray)];
    cpus.into_iter().chain(gpu().map(|gpu| ("wgpu", gpu))).collect()
}

/// The GPU, or what computes like one; says so if there is none.
#[cfg(feature = "wgpu")]
pub fn gpu() -> Option<Device> {
    use burn::tensor::{DeviceKind, DeviceType};
    if Device::enumerate(DeviceType::Wgpu).is_empty() {
        eprintln!("not tested on wgpu: no adapter");
        return None;
    }
    Some(Device::wgpu(DeviceKind::DefaultDevice))
}

/// None in this build.
#[cfg(not(feature = "wgpu"))]
pub fn gpu() -> Option<Device> {
    None
}

/// Random numbers from -1 to 2.
pub fn random<const D: usize>(shape: [usize; D], seed: u64, device: &Device) -> Tensor<D> {
    let mut random = data::stream(seed, "values", 0, 0);
    let values: Vec<f32> = (0..shape.iter().product()).map(|_| random.random_range(-1.0..2.0)).collect();
    Tensor::from_data(TensorData::new(values, shape), device)
}
