//! Products of matrices, many side by side, and sums of many of them.

use super::tensor_cores::{self, Tile, products_of_fragments};
use super::{Primitive, UNITS, argument, cubes};
use burn::backend::Cube;
use burn::backend::TensorMetadata;
use burn::backend::ops::FloatTensorOps;
use burn::tensor::{DType, Shape, bf16, f16};
use cubecl::prelude::*;

/// Rows and columns of a product that a cube computes.
const SIDE: usize = crate::products::TILE;

/// Columns of the first matrix, and rows of the second, that a cube reads at a time.
const DEPTH: usize = 16;

/// Rows and columns that a unit computes. Larger tiles (64 x 128, 128 x 128) were 3 to 8 % slower on an H200 in a step
/// of PointPillars.
const OWN: usize = 4;

const _: () = assert!((SIDE / OWN) * (SIDE / OWN) == UNITS as usize && UNITS == 256);

/// Where the values of a matrix lie: steps between matrices of both outer dimensions, rows and columns.
#[derive(CubeType, CubeLaunch, Clone, Copy)]
pub(super) struct Steps {
    pub outer: u32,
    pub inner: u32,
    pub row: u32,
    pub column: u32,
}

/// A cube for each tile along the columns (x) and rows (y) of each product (z).
#[cube(launch_unchecked)]
fn products(
    a: &[f32],
    b: &[f32],
    out: &mut [f32],
    of_a: Steps,
    of_b: Steps,
    inner: u32,
    rows: u32,
    columns: u32,
    terms: u32,
    #[comptime] a_by_columns: bool,
    #[comptime] b_by_columns: bool,
) {
    let lanes = comptime!(SIDE / OWN);
    let mut part_a = Shared::<[f32]>::new_slice(comptime!(DEPTH * SIDE));
    let mut part_b = Shared::<[f32]>::new_slice(comptime!(DEPTH * SIDE));
    let mut sums = Array::<f32>::new(comptime!(OWN * OWN));
    let mut own_a = Array::<f32>::new(comptime!(OWN));
    let mut own_b = Array::<f32>::new(comptime!(OWN));
    #[unroll]
    for i in 0..comptime!(OWN * OWN) {
        sums[i] = 0.0f32;
    }
    let unit = UNIT_POS as usize;
    let (own_row, own_column) = (unit / lanes, unit % lanes);
    let (first_row, first_column) = (CUBE_POS_Y as usize * SIDE, CUBE_POS_X as usize * SIDE);
    let (rows, columns, terms) = (rows as usize, columns as usize, terms as usize);
    let (at_outer, at_inner) = (CUBE_POS_Z / inner, CUBE_POS_Z % inner);
    let begin_a = (at_outer * of_a.outer + at_inner * of_a.inner) as usize;
    let begin_b = (at_outer * of_b.outer + at_inner * of_b.inner) as usize;
    let mut first = 0usize;
    while first < terms {
        #[unroll]
        for j in 0..comptime!(DEPTH * SIDE / 256) {
            let e = unit + j * 256;
            let mut row = e % SIDE;
            let mut term = e / SIDE;
            if a_by_columns {
                row = e / DEPTH;
                term = e % DEPTH;
            }
            let mut value = 0.0f32;
            if first_row + row < rows && first + term < terms {
                value = a[begin_a + (first_row + row) * of_a.row as usize + (first + term) * of_a.column as usize];
            }
            part_a[term * SIDE + row] = value;
        }
        #[unroll]
        for j in 0..comptime!(DEPTH * SIDE / 256) {
            let e = unit + j * 256;
            let mut column = e / DEPTH;
            let mut term = e % DEPTH;
            if b_by_columns {
                column = e % SIDE;
                term = e / SIDE;
            }
            let mut value = 0.0f32;
            if first_column + column < columns && first + term < terms {
                value =
                    b[begin_b + (first + term) * of_b.row as usize + (first_column + column) * of_b.column as usize];
            }
            part_b[term * SIDE + column] = value;
        }
        sync_cube();
        #[unroll]
        for term in 0..comptime!(DEPTH) {
            #[unroll]
            for i in 0..comptime!(OWN) {
                own_a[i] = part_a[term * SIDE + own_row * OWN + i];
            }
            #[unroll]
            for j in 0..comptime!(OWN) {
                own_b[j] = part_b[term * SIDE + own_column + j * lanes];
            }
            #[unroll]
            for i in 0..comptime!(OWN) {
                #[unroll]
                for j in 0..comptime!(OWN) {
                    sums[i * OWN + j] = fma(own_a[i], own_b[j], sums[i * OWN + j]);
                }
            }
        }
        sync_cube();
        first += DEPTH;
    }
    let begin = CUBE_POS_Z as usize * rows * columns;
    #[unroll]
    for i in 0..comptime!(OWN) {
        let row = first_row + own_row * OWN + i;
        #[unroll]
        for j in 0..comptime!(OWN) {
            let column = first_column + own_column + j * lanes;
            if row < rows && column < columns {
                out[begin + row * columns + column] = sums[i * OWN + j];
            }
        }
    }
}

/// Sums over the first dimension: a unit for each value.
#[cube(launch_unchecked)]
fn sums_of_first(x: &[f32], out: &mut [f32], count: u32) {
    let i = ABSOLUTE_POS;
    if i < out.len() {
        let mut sum = 0.0f32;
        for k in 0..count as usize {
            sum += x[k * out.len() + i];
        }
        out[i] = sum;
    }
}

/// Products of matrices, in single precision. `None` for another precision.
///
/// # Shapes
/// `a`: `[.., M, K]`; `b`: `[.., K, N]`, each with up to two dimensions in front, which are those of the other one or
/// 1; result `[.., M, N]`.
pub(crate) fn product(a: &Primitive, b: &Primitive) -> Option<Primitive> {
    let (of_a, of_b) = (a.shape(), b.shape());
    let dims = of_a.num_dims();
    let is_plain =
        a.dtype() == DType::F32 && b.dtype() == DType::F32 && (2..=4).contains(&dims) && of_b.num_dims() == dims;
    let sizes = [of_a.num_elements(), of_b.num_elements()];
    if !is_plain || sizes.contains(&0) {
        return None;
    }
    // Two outer dimensions, then the matrix.
    let sizes_and_steps = |tensor: &Primitive| {
        let (shape, strides) = (tensor.shape(), tensor.meta.strides());
        let mut all = [(1, 0); 4];
        for d in 0..dims {
            let step = if shape[d] == 1 { 0 } else { strides[d] };
            all[4 - dims + d] = (shape[d], step);
        }
        all
    };
    let (a_is, b_is) = (sizes_and_steps(a), sizes_and_steps(b));
    let [outer, inner] = [0, 1].map(|d| a_is[d].0.max(b_is[d].0));
    let fits = |is: &[(usize, usize); 4]| {
        [outer, inner].iter().zip(is).all(|(size, own)| own.0 == *size || own.0 == 1)
            && is.iter().map(|(size, step)| (size - 1) * step).sum::<usize>() < u32::MAX as usize
    };
    let (rows, terms, columns) = (a_is[2].0, a_is[3].0, b_is[3].0);
    let values = outer * inner * rows * columns;
    if !fits(&a_is) || !fits(&b_is) || b_is[2].0 != terms || values >= 1 << 32 || outer * inner > 65_535 {
        return None;
    }
    let mut shape: Vec<usize> = vec![outer, inner, rows, columns];
    shape.drain(..4 - dims);
    let out = Cube::float_empty(Shape::from(shape), &a.device, a.dtype().into());
    let tile = tensor_cores::are_had_by(a.client.properties()).then(|| Tile::of_product(rows));
    let of_cube = tile.map_or([SIDE, SIDE], |tile| [tile.columns, tile.rows]);
    let grid = [columns.div_ceil(of_cube[0]), rows.div_ceil(of_cube[1]), outer * inner].map(|n| n as u32);
    if grid[1] > 65_535 {
        return None;
    }
    let steps = |is: &[(usize, usize); 4]| {
        let [outer, inner, row, column] = is.map(|(_, step)| step as u32);
        StepsLaunch::new(outer, inner, row, column)
    };
    let whole = |tensor: &Primitive, is: &[(usize, usize); 4]| {
        let last = is.iter().map(|(size, step)| (size - 1) * step).sum::<usize>();
        // SAFETY: the buffer of a tensor reaches to its last value.
        unsafe { BufferArg::from_raw_parts(tensor.handle.clone(), last + 1) }
    };
    if let Some(tile) = tile {
        let launch = if tile.parts == 1 {
            products_of_fragments::launch_unchecked::<f16>
        } else {
            products_of_fragments::launch_unchecked::<bf16>
        };
        // SAFETY: places outside of the matrices are neither read nor written.
        unsafe {
            launch(
                &a.client,
                CubeCount::Static(grid[0], grid[1], grid[2]),
                CubeDim::new_1d(tile.units() as u32),
                whole(a, &a_is),
                whole(b, &b_is),
                argument(&out),
                steps(&a_is),
                steps(&b_is),
                inner as u32,
                rows as u32,
                columns as u32,
                terms as u32,
                a_is[3].1 == 1,
                b_is[3].1 == 1,
                tile,
            );
        }
        return Some(out);
    }
    // SAFETY: places outside of the matrices are neither read nor written.
    unsafe {
        products::launch_unchecked(
            &a.client,
            CubeCount::Static(grid[0], grid[1], grid[2]),
            CubeDim::new_1d(UNITS),
            whole(a, &a_is),
            whole(b, &b_is),
            argument(&out),
            steps(&a_is),
            steps(&b_is),
            inner as u32,
            rows as u32,
            columns as u32,
            terms as u32,
            a_is[3].1 == 1,
            b_is[3].1 == 1,
        );
    }
    Some(out)
}

/// The sum over the first dimension. `None` for another precision than single, or gaps.
///
/// # Shapes
/// `x`: `[P, N]`; result `[1, N]`.
pub(crate) fn sum_of_first(x: &Primitive) -> Option<Primitive> {
    if !super::is_plain(x) {
        return None;
    }
    let [count, values] = x.shape().dims();
    let out = Cube::float_empty(Shape::from([1, values]), &x.device, x.dtype().into());
    // SAFETY: the unit of a value reads what is summed to it.
    unsafe {
        sums_of_first::launch_unchecked(
            &x.client,
            cubes(values),
            CubeDim::new_1d(UNITS),
            argument(x),
            argument(&out),
            count as u32,
        );
    }
    Some(out)
}
