//! What the units of a cube compute in several kernels.

use cubecl::prelude::*;

/// The sum over the units of a cube, for each of them.
#[cube]
pub(super) fn sum_of_cube(value: f32) -> f32 {
    let mut sums = Shared::<[f32]>::new_slice(256usize);
    let unit = UNIT_POS as usize;
    sums[unit] = value;
    sync_cube();
    let mut width = 128usize;
    while width > 0 {
        if unit < width {
            sums[unit] += sums[unit + width];
        }
        sync_cube();
        width /= 2;
    }
    sums[0]
}

/// The sum of the parts of a channel.
#[cube]
pub(super) fn sum_of_parts(parts: &[f32], channel: usize, count: usize) -> f32 {
    let mut sum = 0.0f32;
    for part in 0..count {
        sum += parts[channel * count + part];
    }
    sum
}

/// Where a value of a channel lies: `i` counts the pixels of all frames.
#[cube]
pub(super) fn place(i: usize, channel: usize, channels: usize, pixels: usize) -> usize {
    ((i / pixels) * channels + channel) * pixels + i % pixels
}

/// The end of a part of some values.
#[cube]
pub(super) fn end_of(part: usize, of_part: usize, values: usize) -> usize {
    let mut end = (part + 1) * of_part;
    if end > values {
        end = values;
    }
    end
}

/// A normalised value after a ReLU, if there is one. What is not a number stays so.
#[cube]
pub(super) fn rectified(value: f32, #[comptime] relu: bool) -> f32 {
    let mut value = value;
    if comptime!(relu) {
        value = select(value < 0.0, 0.0f32, value);
    }
    value
}

/// The gradient by a normalised value, if a ReLU lets it through.
#[cube]
pub(super) fn passed(gradient: f32, value: f32, #[comptime] relu: bool) -> f32 {
    let mut gradient = gradient;
    if comptime!(relu) {
        gradient = select(value <= 0.0, 0.0f32, gradient);
    }
    gradient
}
