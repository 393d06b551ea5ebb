//! Products of matrices.

use super::{Part, Tile, multiply, write, zeros};
use crate::gpu_kernels::product::Steps;
use cubecl::prelude::*;

/// Products of matrices. A cube for each tile along the columns (x) and rows (y) of each product (z).
#[cube(launch_unchecked)]
pub(in crate::gpu_kernels) fn products_of_fragments<E: Float>(
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
    #[comptime] tile: Tile,
) {
    let units = comptime!(tile.units());
    // Along a line values lie one after the other in memory, here and there.
    let line_a = comptime!(if a_by_columns { tile.depth } else { tile.rows });
    let line_b = comptime!(if b_by_columns { tile.columns } else { tile.depth });
    let [pairs_a, pairs_b] = comptime!(tile.pairs());
    let mut part_a = Part::<E>::new(comptime!(tile.rows * tile.depth / line_a), line_a, tile.parts);
    let mut part_b = Part::<E>::new(comptime!(tile.columns * tile.depth / line_b), line_b, tile.parts);
    let mut next_a = Array::<f32>::new(comptime!(2 * pairs_a));
    let mut next_b = Array::<f32>::new(comptime!(2 * pairs_b));
    let sums = zeros(comptime!(tile.own()[0] * tile.own()[1] * tile.sums()));

    let unit = UNIT_POS as usize;
    let first_row = CUBE_POS_Y as usize * comptime!(tile.rows);
    let first_column = CUBE_POS_X as usize * comptime!(tile.columns);
    let (rows, columns, terms) = (rows as usize, columns as usize, terms as usize);
    let (at_outer, at_inner) = (CUBE_POS_Z / inner, CUBE_POS_Z % inner);
    let begin_a = (at_outer * of_a.outer + at_inner * of_a.inner) as usize;
    let begin_b = (at_outer * of_b.outer + at_inner * of_b.inner) as usize;

    // One more round than parts: each computes with what the round before has read.
    let mut first = 0usize;
    while first < terms + comptime!(tile.depth) {
        if first > 0 {
            sync_cube();
            part_a.set(&next_a, pairs_a, line_a, units, tile.parts);
            part_b.set(&next_b, pairs_b, line_b, units, tile.parts);
            sync_cube();
        }
        if first < terms {
            #[unroll]
            for j in 0..pairs_a {
                let e = 2 * (unit + j * units);
                #[unroll]
                for k in 0..2usize {
                    let mut row = first_row + e % line_a + k;
                    let mut term = first + e / line_a;
                    if comptime!(a_by_columns) {
                        row = first_row + e / line_a;
                        term = first + e % line_a + k;
                    }
                    let mut value = 0.0f32;
                    if row < rows && term < terms {
                        value = a[begin_a + row * of_a.row as usize + term * of_a.column as usize];
                    }
                    next_a[2 * j + k] = value;
                }
            }
            #[unroll]
            for j in 0..pairs_b {
                let e = 2 * (unit + j * units);
                #[unroll]
                for k in 0..2usize {
                    let mut column = first_column + e / line_b;
                    let mut term = first + e % line_b + k;
                    if comptime!(b_by_columns) {
                        column = first_column + e % line_b + k;
                        term = first + e / line_b;
                    }
                    let mut value = 0.0f32;
                    if column < columns && term < terms {
                        value = b[begin_b + term * of_b.row as usize + column * of_b.column as usize];
                    }
                    next_b[2 * j + k] = value;
                }
            }
        }
        if first > 0 {
            multiply::<E>(&part_a, &part_b, &sums, a_by_columns, b_by_columns, tile);
        }
        first += comptime!(tile.depth);
    }
    write(&sums, out, CUBE_POS_Z as usize * rows * columns, rows, columns, tile);
}
