//! Command line options that choose the device, its kernels and the precision.

use anyhow::{Result, bail};
use burn::tensor::Device;
use clap::{Args, ValueEnum};
use kernels::InstructionSet;
use models::kernel_ops::{Kernels, choose_kernels};
use models::layers::{Precision, choose_precision};
use serde::Serialize;
use study::GPU_VARIABLE;

/// The device on which the network runs, its kernels and the precision.
#[derive(Args, Clone, Debug)]
pub struct DeviceArgs {
    /// Device on which the network runs: flex (CPU), ndarray (CPU), wgpu or cuda
    #[arg(long, default_value = "flex")]
    pub device: String,
    /// Kernels of the device flex
    #[arg(long, value_enum, default_value = "auto")]
    pub kernels: KernelChoice,
    /// Precision of convolutions and linear layers
    #[arg(long, value_enum, default_value = "f32")]
    pub precision: PrecisionChoice,
}

/// Floating point precision of convolutions and linear layers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum PrecisionChoice {
    /// Single precision
    F32,
    /// As f32, with products rounded to 16 bits on GPUs whose tensor cores have bf16 (TF32: 11 bits)
    High,
    /// Half precision, on wgpu and cuda only; batch norms, losses, weights and optimiser stay f32
    F16,
}

/// Implementations of the operations that take most time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum KernelChoice {
    /// This program's kernels; convolutions use Winograd's F(2x2, 3x3)
    Auto,
    /// As auto, but with F(4x4, 3x3): slightly faster, one digit less accurate
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
    /// Opens the device. The choice of kernels and precision applies to the whole process from now on.
    ///
    /// # Errors
    /// As [`parse_device`]; an unknown instruction set in the environment; half precision on a device that does not
    /// support it.
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
            PrecisionChoice::High => Precision::High,
            PrecisionChoice::F16 => Precision::F16,
        };
        if precision == Precision::F16 && matches!(self.device.as_str(), "flex" | "ndarray") {
            bail!("--precision f16 is for GPUs (--device wgpu or cuda); on the CPU it would be slower");
        }
        if !precision.runs_on(&device) {
            bail!("device {} does not compute in half precision; remove --precision f16", self.device);
        }
        choose_precision(precision);
        Ok(device)
    }

    /// The command line arguments that give another process the same options.
    pub fn arguments(&self) -> Vec<String> {
        let kernels = self.kernels.to_possible_value().map_or(String::new(), |value| value.get_name().to_string());
        let mut arguments = ["--device", &self.device, "--kernels", &kernels].map(String::from).to_vec();
        if self.precision != PrecisionChoice::F32 {
            let precision = self.precision.to_possible_value();
            arguments.extend(precision.into_iter().flat_map(|value| ["--precision".into(), value.get_name().into()]));
        }
        arguments
    }

    /// The cards of this machine, by the names that [`GPU_VARIABLE`] takes. None for other devices than `wgpu`, and if
    /// the variable chooses one already.
    pub fn gpus(&self) -> Vec<String> {
        if self.device != "wgpu" || std::env::var_os(GPU_VARIABLE).is_some() { Vec::new() } else { cards() }
    }

    /// Device, kernels and precision as text.
    pub fn describe(&self) -> String {
        match (self.device.as_str(), self.kernels) {
            ("flex", KernelChoice::Burn) => "flex, burn's operations".into(),
            ("flex", choice) => {
                let transform = if choice == KernelChoice::F4 { "F(4x4)" } else { "F(2x2)" };
                let instructions = InstructionSet::in_use().map_or("best", InstructionSet::name);
                format!("flex, own kernels, {instructions}, {transform}")
            }
            (device, _) => match self.precision {
                PrecisionChoice::F32 => device.into(),
                PrecisionChoice::High => format!("{device}, products of two parts"),
                PrecisionChoice::F16 => format!("{device}, half precision"),
            },
        }
    }
}

/// The device with this name: `flex` (the CPU, the default), `ndarray`, `wgpu` or `cuda`.
///
/// # Errors
/// An unknown name, a device that is not compiled in, or one that this machine does not have.
pub fn parse_device(name: &str) -> Result<Device> {
    match name {
        "flex" => Ok(Device::flex()),
        "ndarray" => Ok(ndarray()),
        "wgpu" => wgpu(),
        "cuda" => cuda(),
        _ => bail!("there is no device {name:?}; choose flex, ndarray, wgpu or cuda"),
    }
}

#[expect(deprecated, reason = "kept as long as burn has it")]
fn ndarray() -> Device {
    Device::ndarray()
}

#[cfg(feature = "wgpu")]
fn wgpu() -> Result<Device> {
    use burn::tensor::{DeviceKind, DeviceType};
    // Without this check, a missing adapter would cause a panic on another thread at the first tensor.
    if Device::enumerate(DeviceType::Wgpu).is_empty() {
        bail!("no adapter for wgpu: no Vulkan, Metal or DirectX 12 driver was found; use --device flex");
    }
    Ok(Device::wgpu(DeviceKind::DefaultDevice))
}

/// What computes behind the device `wgpu`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Adapter {
    /// Its own name for itself.
    pub name: String,
    /// Whether it is a card. A rasteriser in software is none.
    pub is_gpu: bool,
}

/// The adapters that the device `wgpu` finds on this machine; none without the feature `wgpu`.
#[cfg(feature = "wgpu")]
pub fn adapters() -> Vec<Adapter> {
    let identities = Device::enumerate(burn::tensor::DeviceType::Wgpu).into_iter().filter_map(|d| d.identity());
    identities.map(|found| Adapter { name: found.name, is_gpu: found.physical.is_some() }).collect()
}

/// The adapters that the device `wgpu` finds on this machine; none without the feature `wgpu`.
#[cfg(not(feature = "wgpu"))]
pub fn adapters() -> Vec<Adapter> {
    Vec::new()
}

/// Names of the cards that `wgpu` finds, such as `DiscreteGpu(0)`, without opening them.
#[cfg(feature = "wgpu")]
fn cards() -> Vec<String> {
    let devices = Device::enumerate(burn::tensor::DeviceType::Wgpu);
    devices.into_iter().filter_map(|device| card_in(&format!("{device:?}"))).collect()
}

/// burn names the kind of a device in its debugging output only.
#[cfg(feature = "wgpu")]
fn card_in(text: &str) -> Option<String> {
    let found = &text[text.find("DiscreteGpu(")?..];
    Some(found[..=found.find(')')?].into())
}

#[cfg(not(feature = "wgpu"))]
fn cards() -> Vec<String> {
    Vec::new()
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
