//! Copies of rows, and sums of blocks of them.

use super::norm_relu::plain;
use super::{Primitive, UNITS, argument, cubes};
use burn::backend::ops::FloatTensorOps;
use burn::backend::tensor::IntTensor;
use burn::backend::{Cube, TensorMetadata};
use burn::tensor::Shape;
use cubecl::prelude::*;

/// A unit for each value of a sum. Rows below 0 are left out.
#[cube(launch_unchecked)]
fn sums(x: &[f32], rows: &[i32], out: &mut [f32], channels: u32, width: u32) {
    let i = ABSOLUTE_POS;
    if i < out.len() {
        let (channels, width) = (channels as usize, width as usize);
        let (block, channel) = (i / channels, i % channels);
        let mut sum = 0.0f32;
        for k in 0..width {
            let row = rows[block * width + k];
            if row >= 0 {
                sum += x[row as usize * channels + channel];
            }
        }
        out[i] = sum;
    }
}

/// Sums of blocks of `width` rows; of one row, copies.
///
/// # Shapes
/// `x`: `[N, C]`, in single precision; `rows`: rows of `x`, one block after the other, or -1 for none, `[B * width]`;
/// result `[B, C]`.
pub(crate) fn sums_of_blocks(x: Primitive, rows: &IntTensor<Cube>, width: usize) -> Primitive {
    let x = plain(x);
    let channels = x.shape()[1];
    let out = Cube::float_empty(Shape::from([rows.shape()[0] / width, channels]), &x.device, x.dtype().into());
    // SAFETY: rows are those of `x`.
    unsafe {
        sums::launch_unchecked(
            &x.client,
            cubes(out.shape().num_elements()),
            CubeDim::new_1d(UNITS),
            argument(&x),
            argument(rows),
            argument(&out),
            channels as u32,
            width as u32,
        );
    }
    out
}
