//! 3x3 convolutions and their gradients by the weights.

use super::{Part, Tile, multiply, write, zeros};
use crate::gpu_kernels::{Primitive, argument, is_plain};
use burn::backend::ops::FloatTensorOps;
use burn::backend::tensor::IntTensor;
use burn::backend::{Cube, TensorMetadata};
use burn::tensor::{DType, Shape, bf16, f16};
use cubecl::prelude::*;

/// 3x3 convolutions, or their gradients by the weights, of images that are not unfolded.
///
/// Forward: a cube for each tile of pixels of the result (x) and channels of the result (y) of each frame (z), `a`:
/// weights `[9, rows, channels]`. Else a cube for each tile of channels of the image (x) and of the result (y), of each
/// tap, part of the pixels and frame (z), `a`: gradients `[B, rows, outputs]`; each part has its own result.
///
/// # Arguments
/// `x`: images `[B, channels, pixels]`; `taps`: the pixel that a tap reads, or `pixels` for none, `[9, outputs]`;
/// `of_part`: pixels of a part.
#[cube(launch_unchecked)]
fn convolutions<E: Float>(
    a: &[f32],
    x: &[f32],
    taps: &[i32],
    out: &mut [f32],
    rows: u32,
    channels: u32,
    pixels: u32,
    outputs: u32,
    of_part: u32,
    #[comptime] forward: bool,
    #[comptime] tile: Tile,
) {
    let units = comptime!(tile.units());
    let depth = comptime!(tile.depth);
    let line_b = comptime!(if forward { tile.columns } else { tile.depth });
    let [pairs_a, pairs_b] = comptime!(tile.pairs());
    let mut part_a = Part::<E>::new(comptime!(tile.rows), depth, tile.parts);
    let mut part_b = Part::<E>::new(comptime!(tile.columns * tile.depth / line_b), line_b, tile.parts);
    let mut next_a = Array::<f32>::new(comptime!(2 * pairs_a));
    let mut next_b = Array::<f32>::new(comptime!(2 * pairs_b));
    let sums = zeros(comptime!(tile.own()[0] * tile.own()[1] * tile.sums()));

    let pair = 2 * UNIT_POS as usize;
    let first_row = CUBE_POS_Y as usize * comptime!(tile.rows);
    let first_column = CUBE_POS_X as usize * comptime!(tile.columns);
    let (rows, channels, pixels) = (rows as usize, channels as usize, pixels as usize);
    let (outputs, of_part) = (outputs as usize, of_part as usize);
    let z = CUBE_POS_Z as usize;
    // Terms are channels, tap by tap, or pixels.
    let mut tap = 0usize;
    let mut frame = z;
    let mut terms = channels;
    let mut begin = 0usize;
    if comptime!(!forward) {
        let parts = outputs / of_part;
        tap = z % 9;
        frame = z / 9 / parts;
        terms = of_part;
        begin = (z / 9) % parts * of_part;
    }
    let image = frame * channels * pixels;
    let mut first = 0usize;
    let mut ends = false;
    // A unit reads the same pixels of several channels: what the tap reads there is looked up a round before.
    let mut read = Array::<u32>::new(2usize);
    #[unroll]
    for k in 0..2usize {
        let mut pixel = pair % line_b + k;
        let mut end = of_part;
        if comptime!(forward) {
            pixel += first_column;
            end = outputs;
        }
        read[k] = pixels as u32;
        if pixel < end {
            read[k] = taps[tap * outputs + begin + pixel] as u32;
        }
    }
    let mut has_part = false;
    while !ends || has_part {
        let multiplies = has_part;
        if multiplies {
            sync_cube();
            part_a.set(&next_a, pairs_a, depth, units, tile.parts);
            part_b.set(&next_b, pairs_b, line_b, units, tile.parts);
            sync_cube();
        }
        has_part = !ends;
        if !ends {
            #[unroll]
            for j in 0..pairs_a {
                let row = first_row + pair / depth + comptime!(j * 2 * units / depth);
                let term = first + pair % depth;
                let mut at = (tap * rows + row) * channels + term;
                if comptime!(!forward) {
                    at = (frame * rows + row) * outputs + begin + term;
                }
                #[unroll]
                for k in 0..2usize {
                    let mut value = 0.0f32;
                    if row < rows && term + k < terms {
                        value = a[at + k];
                    }
                    next_a[2 * j + k] = value;
                }
            }
            #[unroll]
            for j in 0..pairs_b {
                let mut channel = pair / line_b + comptime!(j * 2 * units / line_b);
                if comptime!(forward) {
                    channel += first;
                } else {
                    channel += first_column;
                }
                let at = image + channel * pixels;
                #[unroll]
                for k in 0..2usize {
                    let mut value = 0.0f32;
                    if channel < channels && (read[k] as usize) < pixels {
                        value = x[at + read[k] as usize];
                    }
                    next_b[2 * j + k] = value;
                }
            }
            first += depth;
            if first >= terms {
                if comptime!(forward) {
                    first = 0;
                    tap += 1;
                    ends = tap == 9;
                } else {
                    ends = true;
                }
            }
            if !ends {
                #[unroll]
                for k in 0..2usize {
                    let mut pixel = pair % line_b + k;
                    let mut end = outputs;
                    if comptime!(forward) {
                        pixel += first_column;
                    } else {
                        pixel += first;
                        end = of_part;
                    }
                    read[k] = pixels as u32;
                    if pixel < end {
                        read[k] = taps[tap * outputs + begin + pixel] as u32;
                    }
                }
            }
        }
        if multiplies {
            multiply::<E>(&part_a, &part_b, &sums, true, forward, tile);
        }
    }
    let mut columns = outputs;
    if comptime!(!forward) {
        columns = channels;
    }
    write(&sums, out, z * rows * columns, rows, columns, tile);
}

/// Whether [`convolution`] and [`convolution_gradient`] take an image: it is in single precision, and the device has
/// tensor cores.
pub(crate) fn has_convolutions(x: &Primitive) -> bool {
    x.dtype() == DType::F32 && super::are_had_by(x.client.properties())
}

/// A 3x3 convolution of images that are not unfolded. `None` for values with gaps, or too many.
///
/// # Shapes
/// `weight`: `[9, M, C]`; `x`: `[B, C, pixels]`; `taps`: `[9 * N]`; result `[B, M, N]`.
pub(crate) fn convolution(weight: &Primitive, x: &Primitive, taps: &IntTensor<Cube>) -> Option<Primitive> {
    let [_, rows, _] = weight.shape().dims();
    convolve(weight, x, taps, rows, None)
}

/// The gradient of a 3x3 convolution by its weights, for each frame and part of the pixels. `None` as above.
///
/// # Shapes
/// `dy`: `[B, M, N]`; `x`: `[B, C, pixels]`; `taps`: `[9 * N]`; result `[B * parts, 9, M, C]`.
pub(crate) fn convolution_gradient(
    dy: &Primitive,
    x: &Primitive,
    taps: &IntTensor<Cube>,
    parts: usize,
) -> Option<Primitive> {
    let [_, rows, _] = dy.shape().dims();
    convolve(dy, x, taps, rows, Some(parts))
}

fn convolve(
    a: &Primitive,
    x: &Primitive,
    taps: &IntTensor<Cube>,
    rows: usize,
    parts: Option<usize>,
) -> Option<Primitive> {
    if !is_plain(a) || !is_plain(x) || taps.dtype() != DType::I32 {
        return None;
    }
    let tile = if parts.is_some() { Tile::of_gradient() } else { Tile::of_product(rows) };
    let [batch, channels, pixels] = x.shape().dims();
    let outputs = taps.shape()[0] / 9;
    let (columns, side_by_side, shape) = match parts {
        None => (outputs, batch, Shape::from([batch, rows, outputs])),
        Some(parts) => (channels, batch * parts * 9, Shape::from([batch * parts, 9, rows, channels])),
    };
    let grid = [columns.div_ceil(tile.columns), rows.div_ceil(tile.rows), side_by_side].map(|n| n as u32);
    let values = [a.shape().num_elements(), x.shape().num_elements(), shape.num_elements(), 9 * outputs];
    if grid[1] > 65_535 || grid[2] > 65_535 || values.iter().any(|values| *values >= 1 << 32) {
        return None;
    }
    let out = Cube::float_empty(shape, &a.device, a.dtype().into());
    let launch =
        if tile.parts == 1 { convolutions::launch_unchecked::<f16> } else { convolutions::launch_unchecked::<bf16> };
    // SAFETY: places outside of the matrices are neither read nor written.
    unsafe {
        launch(
            &a.client,
            CubeCount::Static(grid[0], grid[1], grid[2]),
            CubeDim::new_1d(tile.units() as u32),
            argument(a),
            argument(x),
            argument(taps),
            argument(&out),
            rows as u32,
            channels as u32,
            pixels as u32,
            outputs as u32,
            (outputs / parts.unwrap_or(1)) as u32,
            parts.is_none(),
            tile,
        );
    }
    Some(out)
}
