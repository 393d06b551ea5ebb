//! Largest sizes of networks and of their files.
//!
//! They are beyond what is trained on one machine, and small enough that their products do not overflow. The page
//! `reference/limits.md` of the book lists all limits of the program.

/// Bytes of a file with weights or detections.
pub const MOST_CHECKPOINT_BYTES: u64 = 8 << 30;

/// Bytes of the names of tensors in a safetensors file: about 100,000 names.
pub const MOST_HEADER_BYTES: u64 = 8 << 20;

/// Channels of a layer.
pub const MOST_FILTERS: usize = 8192;

/// Layers of a block, or of a list of layers.
pub const MOST_LAYERS: usize = 128;

/// Stride of a convolution.
pub const MOST_STRIDE: usize = 64;

/// Cells of the canvas of pillars.
pub const MOST_CELLS: usize = 1 << 24;

/// Pillars of a frame.
pub const MOST_PILLARS: usize = 1_000_000;

/// Points of a pillar, neighbours of a point, or points of a region.
pub const MOST_SAMPLES: usize = 16_384;

/// Points of a frame that a network reads.
pub const MOST_NETWORK_POINTS: usize = 1_000_000;

/// Boxes or regions of a frame that a network gives or is trained on.
pub const MOST_NETWORK_BOXES: usize = 1_000_000;

/// Classes of a detector, headings of an anchor, bins of a direction.
pub const MOST_CLASSES: usize = 256;

/// Frames of a step.
pub const MOST_BATCH: usize = 65_536;

/// Epochs of a run.
pub const MOST_EPOCHS: usize = 1_000_000;

/// The first of `sizes` (key and values) that is beyond `most`; the message names the key.
pub(crate) fn at_most(most: usize, sizes: &[(&str, &[usize])]) -> Result<(), String> {
    for (key, values) in sizes {
        if let Some(value) = values.iter().find(|value| **value > most) {
            return Err(format!("{key} = {value}: at most {most} are supported"));
        }
    }
    Ok(())
}
