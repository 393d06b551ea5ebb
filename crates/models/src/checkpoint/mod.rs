//! Weights on disk: OpenPCDet's `.pth` in, safetensors in and out.
//!
//! Tensors keep OpenPCDet's names. What a damaged file says is checked against the file's length before memory is taken, and
//! nothing in a file is ever run. The limits of that: neither torch's older form nor safetensors carries a checksum, so a changed byte
//! **inside a weight** cannot be seen there (torch's zip form has checksums, and they are checked).

mod pickle;
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
    /// Extents; empty for a single number.
    pub shape: Vec<usize>,
    /// As many as the product of the extents.
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
    /// Values from little-endian bytes, a whole number of them.
    fn values(self, bytes: &[u8]) -> HostValues {
        let (four, eight) = (bytes.as_chunks::<4>().0, bytes.as_chunks::<8>().0);
        match self {
            NumberType::F32 => HostValues::F32(four.iter().map(|b| f32::from_le_bytes(*b)).collect()),
            NumberType::F64 => HostValues::F64(eight.iter().map(|b| f64::from_le_bytes(*b)).collect()),
            NumberType::I64 => HostValues::I64(eight.iter().map(|b| i64::from_le_bytes(*b)).collect()),
        }
    }
}

/// Weights of a network, from OpenPCDet's `.pth` (torch's zip form or the older one that OpenPCDet writes) or from safetensors.
/// The content says which, not the name.
///
/// # Errors
/// A file that cannot be read, is none of the three, is damaged or truncated, has bytes left over, or asks to run code.
pub fn read_checkpoint(path: &Path) -> Result<NamedTensors, ModelError> {
    let bytes = fs_err::read(path).map_err(data::DataError::from)?;
    parse_checkpoint(path, &bytes)
}

/// The same of a file that is in memory already; `path` is only for messages.
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
        _ => Err("is no checkpoint: neither torch's (.pth) nor safetensors, or its beginning is damaged".into()),
    }
}

/// Whether a file that begins with 0x80 is a pickle with a long number or a frame first, and not a safetensors header of 128 bytes.
fn is_pickle(protocol: u8, opcode: u8) -> bool {
    protocol > 0 && (opcode == 0x8a || opcode == 0x95)
}

fn file_error(path: &Path, message: impl Into<String>) -> ModelError {
    ModelError::File { path: path.into(), message: message.into() }
}
