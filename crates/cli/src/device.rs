//! Where tensors live: a device by its name.

use anyhow::{Result, bail};
use burn::tensor::Device;

/// The device of that name: `flex` (the CPU, the default), `ndarray`, `wgpu` or `cuda`.
///
/// # Errors
/// A name that does not exist, a device that is not built in, or one that this machine lacks.
pub fn parse_device(name: &str) -> Result<Device> {
    match name {
        "flex" => Ok(Device::flex()),
        "ndarray" => Ok(ndarray()),
        "wgpu" => wgpu(),
        "cuda" => cuda(),
        _ => bail!("there is no device {name:?}: flex, ndarray, wgpu or cuda"),
    }
}

#[expect(deprecated, reason = "offered as long as burn has it")]
fn ndarray() -> Device {
    Device::ndarray()
}

#[cfg(feature = "wgpu")]
fn wgpu() -> Result<Device> {
    use burn::tensor::{DeviceKind, DeviceType};
    // Without an adapter the first tensor would panic on another thread.
    if Device::enumerate(DeviceType::Wgpu).is_empty() {
        bail!("no adapter for wgpu: no Vulkan, Metal or DirectX 12 driver was found; use --device flex");
    }
    Ok(Device::wgpu(DeviceKind::DefaultDevice))
}

#[cfg(not(feature = "wgpu"))]
fn wgpu() -> Result<Device> {
    bail!("this program was built without the feature `wgpu`: `cargo xtask ... --device wgpu` builds it in")
}

#[cfg(feature = "cuda")]
fn cuda() -> Result<Device> {
    Ok(Device::cuda(0))
}

#[cfg(not(feature = "cuda"))]
fn cuda() -> Result<Device> {
    bail!(
        "this program was built without the feature `cuda`: `cargo xtask ... --device cuda` builds it in (its build needs the internet)"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names() {
        assert!(parse_device("flex").is_ok() && parse_device("ndarray").is_ok());
        assert!(parse_device("gpu").unwrap_err().to_string().contains("no device \"gpu\""));
    }
}
