//! Checkpoint files: reads OpenPCDet's `.pth`, reads and writes safetensors.
//!
//! Tensors keep OpenPCDet's names. Sizes in a file are checked against its length before memory is allocated, and code
//! in a file is never run. Limitation: neither torch's legacy format nor safetensors has checksums, so a changed byte
//! **inside a weight** is not detected there. torch's zip format has checksums, which are verified.

pub(crate) mod pickle;
mod pth;
mod safetensors;

pub use self::safetensors::{read_metadata, read_safetensors, write_safetensors};

use crate::ModelError;
use std::collections::BTreeMap;
use std::path::Path;

/// Tensors by OpenPCDet's names.
pub type NamedTensors = BTreeMap<String, HostTensor>;

/// A tensor in main memory, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct HostTensor {
    /// Dimensions; empty for a scalar.
    pub shape: Vec<usize>,
    /// As many as the product of the dimensions.
    pub values: HostValues,
}

/// Values of one type.
#[derive(Clone, Debug, PartialEq)]
pub enum HostValues {
    /// Weights and statistics.
    F32(Vec<f32>),
    /// Sums and losses.
    F64(Vec<f64>),
    /// Counters and indices.
    I64(Vec<i64>),
}

/// The number types that tensors are stored in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum NumberType {
    F32,
    F64,
    I64,
}

impl NumberType {
    /// Values from little-endian bytes; the length must be a multiple of the element size.
    fn values(self, bytes: &[u8]) -> HostValues {
        let (four, eight) = (bytes.as_chunks::<4>().0, bytes.as_chunks::<8>().0);
        match self {
            NumberType::F32 => HostValues::F32(four.iter().map(|b| f32::from_le_bytes(*b)).collect()),
            NumberType::F64 => HostValues::F64(eight.iter().map(|b| f64::from_le_bytes(*b)).collect()),
            NumberType::I64 => HostValues::I64(eight.iter().map(|b| i64::from_le_bytes(*b)).collect()),
        }
    }
}

/// Weights of a network from OpenPCDet's `.pth` (torch's zip format, or the legacy format that OpenPCDet writes) or
/// from safetensors. The format is detected from the content, not from the name.
///
/// # Errors
/// A file that cannot be read, has another format, is damaged or truncated, has trailing bytes, or asks to run code.
pub fn read_checkpoint(path: &Path) -> Result<NamedTensors, ModelError> {
    let bytes = data::limits::read_file(path, crate::limits::MOST_CHECKPOINT_BYTES)?;
    parse_checkpoint(path, &bytes)
}

/// The same for the content of a file; `path` is only for messages.
///
/// # Errors
/// As [`read_checkpoint`].
pub fn parse_checkpoint(path: &Path, bytes: &[u8]) -> Result<NamedTensors, ModelError> {
    parse(bytes).map_err(|message| file_error(path, message))
}

fn parse(bytes: &[u8]) -> Result<NamedTensors, String> {
    match bytes {
        [] => Err("is empty".into()),
        [b'P', b'K', ..] => pth::parse_zip(bytes),
        [0x80, protocol, opcode, ..] if is_pickle(*protocol, *opcode) => pth::parse_legacy(bytes),
        [_, _, _, _, _, _, _, _, b'{', ..] => safetensors::parse(bytes),
        _ => Err("is not a checkpoint: neither torch's (.pth) nor safetensors, or its beginning is damaged".into()),
    }
}

/// Whether a file that begins with 0x80 is a pickle whose first opcode is a long or a frame, and not a safetensors
/// header of 128 bytes.
fn is_pickle(protocol: u8, opcode: u8) -> bool {
    protocol > 0 && (opcode == 0x8a || opcode == 0x95)
}

fn file_error(path: &Path, message: impl Into<String>) -> ModelError {
    ModelError::File { path: path.into(), message: message.into() }
}
