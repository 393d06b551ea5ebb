//! Maxima over groups of consecutive rows.

use super::norm_relu::plain;
use super::{Primitive, UNITS, argument, cubes};
use burn::backend::ops::{FloatTensorOps, IntTensorOps};
use burn::backend::tensor::IntTensor;
use burn::backend::{Cube, TensorMetadata};
use burn::tensor::{IntDType, Shape};
use cubecl::prelude::*;

/// A unit for each group and channel. Of equal rows the first is the maximum; what is no number is one.
#[cube(launch_unchecked)]
fn maxima(x: &[f32], ends: &[i32], out: &mut [f32], winners: &mut [i32], channels: u32) {
    let i = ABSOLUTE_POS;
    if i < out.len() {
        let channels = channels as usize;
        let (group, channel) = (i / channels, i % channels);
        let mut winner = 0usize;
        if group > 0 {
            winner = ends[group - 1] as usize;
        }
        let mut best = x[winner * channels + channel];
        for row in winner + 1..ends[group] as usize {
            let value = x[row * channels + channel];
            if value > best || value.is_nan() {
                best = value;
                winner = row;
            }
        }
        out[i] = best;
        winners[i] = winner as i32;
    }
}

/// A unit for each maximum: its gradient goes to its row.
#[cube(launch_unchecked)]
fn gradients(dy: &[f32], winners: &[i32], out: &mut [f32], channels: u32) {
    let i = ABSOLUTE_POS;
    if i < dy.len() {
        let channels = channels as usize;
        out[winners[i] as usize * channels + i % channels] = dy[i];
    }
}

/// The maxima of groups, and their rows.
///
/// # Shapes
/// `x`: `[N, C]`, in single precision; `ends`: the end of each group, the first begins at 0, `[G]`; results `[G, C]`.
pub(crate) fn maxima_of_groups(x: Primitive, ends: &IntTensor<Cube>) -> (Primitive, IntTensor<Cube>) {
    let x = plain(x);
    let channels = x.shape()[1];
    let shape = Shape::from([ends.shape()[0], channels]);
    let out = Cube::float_empty(shape.clone(), &x.device, x.dtype().into());
    let winners = Cube::int_empty(shape, &x.device, IntDType::I32);
    // SAFETY: groups have rows, and end within `x`.
    unsafe {
        maxima::launch_unchecked(
            &x.client,
            cubes(out.shape().num_elements()),
            CubeDim::new_1d(UNITS),
            argument(&x),
            argument(ends),
            argument(&out),
            argument(&winners),
            channels as u32,
        );
    }
    (out, winners)
}

/// The gradient of maxima by the rows, of which there are `rows`.
///
/// # Shapes
/// `dy` and `winners`: `[G, C]`; result `[rows, C]`.
pub(crate) fn gradient_of_maxima(dy: Primitive, winners: &IntTensor<Cube>, rows: usize) -> Primitive {
    let dy = plain(dy);
    let channels = dy.shape()[1];
    let out = Cube::float_zeros(Shape::from([rows, channels]), &dy.device, dy.dtype().into());
    // SAFETY: winners are below `rows`; groups have no row in common.
    unsafe {
        gradients::launch_unchecked(
            &dy.client,
            cubes(dy.shape().num_elements()),
            CubeDim::new_1d(UNITS),
            argument(&dy),
            argument(winners),
            argument(&out),
            channels as u32,
        );
    }
    out
}
