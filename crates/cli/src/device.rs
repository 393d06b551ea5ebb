//! Where tensors live: a device by its name.

use anyhow::{Result, bail};
use burn::tensor::Device;
use clap::{Args, ValueEnum};
use kernels::InstructionSet;
use models::kernel_ops::{Kernels, choose_kernels};
use models::layers::{Precision, choose_precision};

/// Where the network computes, and how.
#[derive(Args, Clone, Debug)]
pub struct DeviceArgs {
    /// Where the network computes: flex (the CPU), ndarray, wgpu or cuda
    #[arg(long, default_value = "flex")]
    pub device: String,
    /// What computes on flex
    #[arg(long, value_enum, default_value = "auto")]
    pub kernels: KernelChoice,
    /// What convolutions and linear layers multiply
    #[arg(long, value_enum, default_value = "f32")]
    pub precision: PrecisionChoice,
}

/// The floats of the hot operations.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum PrecisionChoice {
    /// Single precision
    F32,
    /// Half precision, on wgpu and cuda; batch norms, losses, weights and optimiser stay f32
    F16,
}

/// The forms of the hot operations.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum KernelChoice {
    /// This program's kernels, convolutions by Winograd's F(2x2, 3x3)
    Auto,
    /// The same with F(4x4, 3x3): a little faster, a digit less exact
    F4,
    /// burn's own operations
    Burn,
}

impl Default for DeviceArgs {
    fn default() -> Self {
        DeviceArgs { device: "flex".into(), kernels: KernelChoice::Auto, precision: PrecisionChoice::F32 }
    }
}

impl DeviceArgs {
    /// The device; the choice of kernels holds for this process from now on.
    ///
    /// # Errors
    /// As [`parse_device`]; an instruction set named in the environment that does not exist; half precision where it does not run.
    pub fn open(&self) -> Result<Device> {
        choose_kernels(match self.kernels {
            KernelChoice::Auto => Kernels::Auto,
            KernelChoice::F4 => Kernels::AutoF4,
            KernelChoice::Burn => Kernels::Burn,
        });
        InstructionSet::in_use()?;
        let device = parse_device(&self.device)?;
        let precision = match self.precision {
            PrecisionChoice::F32 => Precision::F32,
            PrecisionChoice::F16 => Precision::F16,
        };
        if precision == Precision::F16 && matches!(self.device.as_str(), "flex" | "ndarray") {
            bail!("--precision f16 is for GPUs (--device wgpu or cuda): on the CPU it would only be slower");
        }
        if !precision.runs_on(&device) {
            bail!("device {} does not compute in half precision: leave out --precision f16", self.device);
        }
        choose_precision(precision);
        Ok(device)
    }

    /// The words that say the same to another process.
    pub fn words(&self) -> Vec<String> {
        let kernels = self.kernels.to_possible_value().map_or(String::new(), |value| value.get_name().to_string());
        let mut words = ["--device", &self.device, "--kernels", &kernels].map(String::from).to_vec();
        if self.precision == PrecisionChoice::F16 {
            words.extend(["--precision", "f16"].map(String::from));
        }
        words
    }

    /// Device and kernels in words.
    pub fn describe(&self) -> String {
        match (self.device.as_str(), self.kernels) {
            ("flex", KernelChoice::Burn) => "flex, burn's operations".into(),
            ("flex", choice) => {
                let transform = if choice == KernelChoice::F4 { "F(4x4)" } else { "F(2x2)" };
                let instructions = InstructionSet::in_use().map_or("best", InstructionSet::name);
                format!("flex, own kernels, {instructions}, {transform}")
            }
            (device, _) if self.precision == PrecisionChoice::F16 => format!("{device}, half precision"),
            (device, _) => device.into(),
        }
    }
}

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
