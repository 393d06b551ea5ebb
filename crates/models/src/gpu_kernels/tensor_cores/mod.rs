//! Products of matrices and 3x3 convolutions of values in single precision on tensor cores.
//!
//! A value is the sum of three of bf16, each the nearest one to what is missing: 24 bits, which is all of it. Of the
//! nine products of two such sums six are added; the others are below the rounding of the result (Henry et al. 2019,
//! "Leveraging the bfloat16 Artificial Intelligence Datatype For Higher-Precision Computations"). Tensor cores cut off
//! what they add, so that the largest of the six has a sum of its own, which has a sixth of the additions (Ootomo and
//! Yokota 2022, "Recovering single precision accuracy from Tensor Cores"). With [`Precision::High`] two parts and three
//! products are used: a relative error of 2^-16 (TF32: 2^-11). With [`Precision::F16`] a value is rounded to f16, which
//! has as many digits as TF32.

mod convolutions;
mod products;

pub(crate) use convolutions::{convolution, convolution_gradient, has_convolutions};
pub(super) use products::products_of_fragments;

use crate::layers::Precision;
use burn::backend::DispatchDevice;
use burn::tensor::Device;
use cubecl::cmma::{self, Matrix, MatrixIdent, MatrixLayout};
use cubecl::ir::{DeviceProperties, ElemType, FloatKind};
use cubecl::prelude::*;

/// Rows, columns and terms of a fragment, the product that a plane of 32 units computes at once.
const SIDE: usize = 16;

/// Units of a plane.
const PLANE: usize = 32;

/// Values between two lines of shared memory: lines begin in different banks.
const GAP: usize = 8;

/// What a cube computes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) struct Tile {
    /// Rows and columns of the result.
    pub rows: usize,
    pub columns: usize,
    /// Terms that are read at a time.
    pub depth: usize,
    /// Planes along the rows and the columns.
    pub planes: [usize; 2],
    /// Parts of a value: three or two of bf16, or one of f16.
    pub parts: usize,
}

impl Tile {
    /// For gradients by the weights of a convolution.
    pub(super) fn of_gradient() -> Tile {
        Tile { rows: 64, columns: 64, depth: 16, planes: [2, 2], parts: parts() }
    }

    /// For products of some rows.
    pub(super) fn of_product(rows: usize) -> Tile {
        let parts = parts();
        if rows <= 64 || parts == 3 {
            Tile { rows: 64, columns: 128, depth: 16, planes: [2, 4], parts }
        } else {
            Tile { rows: 128, columns: 128, depth: 32, planes: [2, 4], parts }
        }
    }

    /// Sums that a plane has of each fragment.
    const fn sums(&self) -> usize {
        if self.parts == 3 { 2 } else { 1 }
    }

    pub(super) const fn units(&self) -> usize {
        PLANE * self.planes[0] * self.planes[1]
    }

    /// Fragments of a plane along its rows and columns.
    const fn own(&self) -> [usize; 2] {
        [self.rows / self.planes[0] / SIDE, self.columns / self.planes[1] / SIDE]
    }

    /// Pairs of values of both matrices that a unit reads at a time.
    const fn pairs(&self) -> [usize; 2] {
        [self.rows * self.depth / 2 / self.units(), self.columns * self.depth / 2 / self.units()]
    }
}

/// Parts of a value in the chosen precision. Three have all digits of single precision.
fn parts() -> usize {
    match Precision::chosen() {
        Precision::F32 => 3,
        Precision::High => 2,
        Precision::F16 => 1,
    }
}

/// A part of a matrix in shared memory, as sums.
#[derive(CubeType)]
struct Part<E: Float> {
    high: Shared<[Vector<E, Const<2>>]>,
    middle: Shared<[Vector<E, Const<2>>]>,
    low: Shared<[Vector<E, Const<2>>]>,
}

#[cube]
impl<E: Float> Part<E> {
    /// # Arguments
    /// `lines`, `line`: number of lines, and values of a line.
    fn new(#[comptime] lines: usize, #[comptime] line: usize, #[comptime] parts: usize) -> Part<E> {
        let values = comptime!(lines * (line + GAP) / 2);
        // What is not used keeps the next parts on multiples of 16 bytes, from which fragments are loaded.
        let unused = comptime!(GAP / 2);
        Part::<E> {
            high: Shared::<[Vector<E, Const<2>>]>::new_slice(values),
            middle: Shared::<[Vector<E, Const<2>>]>::new_slice(comptime!(if parts >= 2 { values } else { unused })),
            low: Shared::<[Vector<E, Const<2>>]>::new_slice(comptime!(if parts == 3 { values } else { unused })),
        }
    }

    /// Stores the values that a unit has read: pairs along lines, one after the other over the units.
    fn set(
        &mut self,
        values: &Array<f32>,
        #[comptime] pairs: usize,
        #[comptime] line: usize,
        #[comptime] units: usize,
        #[comptime] parts: usize,
    ) {
        #[unroll]
        for j in 0..pairs {
            let e = 2 * (UNIT_POS as usize + j * units);
            let at = (e / line) * comptime!((line + GAP) / 2) + (e % line) / 2;
            let mut pair = Vector::<f32, Const<2>>::empty();
            pair.insert(0usize, values[2 * j]);
            pair.insert(1usize, values[2 * j + 1]);
            let high = Vector::<E, Const<2>>::cast_from(pair);
            self.high[at] = high;
            if comptime!(parts >= 2) {
                let missing = pair - Vector::<f32, Const<2>>::cast_from(high);
                let middle = Vector::<E, Const<2>>::cast_from(missing);
                self.middle[at] = middle;
                if comptime!(parts == 3) {
                    let missing = missing - Vector::<f32, Const<2>>::cast_from(middle);
                    self.low[at] = Vector::<E, Const<2>>::cast_from(missing);
                }
            }
        }
    }
}

/// Sums of products: a fragment each, of the rows and columns of a plane.
#[cube]
fn zeros(#[comptime] count: usize) -> Sequence<Matrix<f32>> {
    let mut sums = Sequence::<Matrix<f32>>::new();
    #[unroll]
    for _ in 0..count {
        sums.push(Matrix::<f32>::from_value(
            MatrixIdent::Accumulator,
            SIDE,
            SIDE,
            SIDE,
            MatrixLayout::Undefined,
            0.0f32,
        ));
    }
    sums
}

/// Adds the products of two parts. The lines of the first one are rows, or terms; those of the second one terms, or
/// columns.
#[cube]
fn multiply<E: Float>(
    a: &Part<E>,
    b: &Part<E>,
    sums: &Sequence<Matrix<f32>>,
    #[comptime] a_by_columns: bool,
    #[comptime] b_by_columns: bool,
    #[comptime] tile: Tile,
) {
    let [own_rows, own_columns] = comptime!(tile.own());
    let step_a = comptime!(GAP + if a_by_columns { tile.depth } else { tile.rows });
    let step_b = comptime!(GAP + if b_by_columns { tile.columns } else { tile.depth });
    let (plane_row, plane_column) = place_of_plane(tile);
    #[unroll]
    for k in 0..comptime!(tile.depth / SIDE) {
        let term = comptime!(k * SIDE);
        let mut of_rows = Sequence::<Matrix<E>>::new();
        #[unroll]
        for i in 0..own_rows {
            let row = plane_row + comptime!(i * SIDE);
            let mut at = term * step_a + row;
            if comptime!(a_by_columns) {
                at = row * step_a + term;
            }
            of_rows.push(fragment::<E>(&a.high, at / 2, MatrixIdent::A, a_by_columns, step_a));
            if comptime!(tile.parts >= 2) {
                of_rows.push(fragment::<E>(&a.middle, at / 2, MatrixIdent::A, a_by_columns, step_a));
            }
            if comptime!(tile.parts == 3) {
                of_rows.push(fragment::<E>(&a.low, at / 2, MatrixIdent::A, a_by_columns, step_a));
            }
        }
        #[unroll]
        for j in 0..own_columns {
            let column = plane_column + comptime!(j * SIDE);
            let mut at = column * step_b + term;
            if comptime!(b_by_columns) {
                at = term * step_b + column;
            }
            let high = fragment::<E>(&b.high, at / 2, MatrixIdent::B, b_by_columns, step_b);
            if comptime!(tile.parts == 1) {
                #[unroll]
                for i in 0..own_rows {
                    let sum = sums.index(comptime!(i * own_columns + j));
                    cmma::execute(of_rows.index(i), &high, sum, sum);
                }
            } else if comptime!(tile.parts == 3) {
                let middle = fragment::<E>(&b.middle, at / 2, MatrixIdent::B, b_by_columns, step_b);
                let low = fragment::<E>(&b.low, at / 2, MatrixIdent::B, b_by_columns, step_b);
                #[unroll]
                for i in 0..own_rows {
                    let small = sums.index(comptime!(2 * (i * own_columns + j) + 1));
                    cmma::execute(of_rows.index(comptime!(3 * i + 2)), &high, small, small);
                    cmma::execute(of_rows.index(comptime!(3 * i)), &low, small, small);
                    cmma::execute(of_rows.index(comptime!(3 * i + 1)), &middle, small, small);
                    cmma::execute(of_rows.index(comptime!(3 * i + 1)), &high, small, small);
                    cmma::execute(of_rows.index(comptime!(3 * i)), &middle, small, small);
                    let sum = sums.index(comptime!(2 * (i * own_columns + j)));
                    cmma::execute(of_rows.index(comptime!(3 * i)), &high, sum, sum);
                }
            } else {
                let middle = fragment::<E>(&b.middle, at / 2, MatrixIdent::B, b_by_columns, step_b);
                #[unroll]
                for i in 0..own_rows {
                    let sum = sums.index(comptime!(i * own_columns + j));
                    cmma::execute(of_rows.index(comptime!(2 * i + 1)), &high, sum, sum);
                    cmma::execute(of_rows.index(comptime!(2 * i)), &middle, sum, sum);
                    cmma::execute(of_rows.index(comptime!(2 * i)), &high, sum, sum);
                }
            }
        }
    }
}

/// The first row and column of the plane of a unit, in the tile of its cube.
#[cube]
fn place_of_plane(#[comptime] tile: Tile) -> (usize, usize) {
    let [own_rows, own_columns] = comptime!(tile.own());
    let across = comptime!(tile.planes[1]);
    let plane = UNIT_POS as usize / PLANE;
    ((plane / across) * comptime!(own_rows * SIDE), (plane % across) * comptime!(own_columns * SIDE))
}

/// Writes the sums of a cube to a matrix that begins somewhere.
#[cube]
fn write(
    sums: &Sequence<Matrix<f32>>,
    out: &mut [f32],
    begin: usize,
    rows: usize,
    columns: usize,
    #[comptime] tile: Tile,
) {
    let [own_rows, own_columns] = comptime!(tile.own());
    let mut patches = Shared::<[f32]>::new_slice(comptime!(tile.units() / PLANE * SIDE * SIDE));
    let (plane_row, plane_column) = place_of_plane(tile);
    let first_row = CUBE_POS_Y as usize * comptime!(tile.rows) + plane_row;
    let first_column = CUBE_POS_X as usize * comptime!(tile.columns) + plane_column;
    let lane = UNIT_POS as usize % PLANE;
    let patch = UNIT_POS as usize / PLANE * comptime!(SIDE * SIDE);
    let own = comptime!(SIDE * SIDE / PLANE);
    let mut values = Array::<f32>::new(own);
    #[unroll]
    for i in 0..own_rows {
        #[unroll]
        for j in 0..own_columns {
            #[unroll]
            for part in 0..comptime!(tile.sums()) {
                sync_cube();
                cmma::store(
                    &mut patches[patch..patch + comptime!(SIDE * SIDE)],
                    sums.index(comptime!(tile.sums() * (i * own_columns + j) + part)),
                    SIDE as u32,
                    MatrixLayout::RowMajor,
                );
                sync_cube();
                #[unroll]
                for k in 0..own {
                    let value = patches[patch + lane + comptime!(k * PLANE)];
                    if comptime!(part == 0) {
                        values[k] = value;
                    } else {
                        values[k] += value;
                    }
                }
            }
            #[unroll]
            for k in 0..own {
                let e = lane + comptime!(k * PLANE);
                let row = first_row + comptime!(i * SIDE) + e / SIDE;
                let column = first_column + comptime!(j * SIDE) + e % SIDE;
                if row < rows && column < columns {
                    out[begin + row * columns + column] = values[k];
                }
            }
        }
    }
}

/// A fragment of shared memory, whose lines are rows, or columns.
#[cube]
fn fragment<E: Float>(
    part: &Shared<[Vector<E, Const<2>>]>,
    at: usize,
    #[comptime] ident: MatrixIdent,
    #[comptime] lines_are_rows: bool,
    #[comptime] step: usize,
) -> Matrix<E> {
    let layout = comptime!(if lines_are_rows { MatrixLayout::RowMajor } else { MatrixLayout::ColMajor });
    let mut read = unsafe { Matrix::<E>::uninitialized(ident, SIDE, SIDE, SIDE, layout) };
    let end = part.len();
    cmma::load(&mut read, &part[at..end], step as u32);
    read
}

/// Whether products round their factors to f16 themselves on a device: its tensor cores have f16.
pub(crate) fn round_to_f16(device: &Device) -> bool {
    parts() == 1
        && match device.clone().inner().as_dispatch() {
            DispatchDevice::Cube(device) => are_had_by(device.client().properties()),
            _ => false,
        }
}

/// Whether a device has tensor cores for such fragments in the chosen precision.
pub(super) fn are_had_by(properties: &DeviceProperties) -> bool {
    let kind = if parts() == 1 { FloatKind::F16 } else { FloatKind::BF16 };
    let (part, f32) = (ElemType::Float(kind), ElemType::Float(FloatKind::F32));
    let hardware = &properties.hardware;
    (hardware.plane_size_min, hardware.plane_size_max) == (PLANE as u32, PLANE as u32)
        && properties.features.matmul.cmma.iter().any(|config| {
            [config.m, config.n, config.k] == [SIDE as u32; 3]
                && (config.a_type, config.b_type, config.cd_type) == (part, part, f32)
        })
}
