//! The innermost loops: products of small matrices whose sums stay in registers.

use crate::simd::{dispatch, multiply_add};
use pulp::{Simd, WithSimd};

/// Pixels (or tiles) that are processed together: two registers of sixteen lanes, four of eight, eight of four.
pub(crate) const PIXELS: usize = 32;

/// Values of [`PIXELS`] pixels.
pub(crate) type Row = [f32; PIXELS];

/// `R` rows of `V` registers.
pub(crate) type Tile<S, const R: usize, const V: usize> = [[<S as Simd>::f32s; V]; R];

/// A computation in register tiles of `R` rows and `V` registers.
pub(crate) trait TileWork {
    /// Its result.
    type Output;

    /// Must be `#[inline(always)]`, like every function that it calls.
    fn run<S: Simd, const R: usize, const V: usize>(self, simd: S) -> Self::Output;
}

/// Runs `work` with the instruction set in use and the largest tiles that fit its registers.
pub(crate) fn dispatch_tiles<W: TileWork>(work: W) -> W::Output {
    struct Sized<W>(W);
    impl<W: TileWork> WithSimd for Sized<W> {
        type Output = W::Output;

        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) -> W::Output {
            // Registers: the sums, a row of the right factor, and one value of the left factor.
            if S::REGISTER_COUNT >= 32 { self.0.run::<S, 8, 2>(simd) } else { self.0.run::<S, 6, 2>(simd) }
        }
    }
    dispatch(Sized(work))
}

/// `R` of [`dispatch_tiles`].
pub(crate) fn tile_rows() -> usize {
    struct Rows;
    impl TileWork for Rows {
        type Output = usize;

        #[inline(always)]
        fn run<S: Simd, const R: usize, const V: usize>(self, _: S) -> usize {
            R
        }
    }
    dispatch_tiles(Rows)
}

/// A tile of zeros.
#[inline(always)]
pub(crate) fn zeros<S: Simd, const R: usize, const V: usize>(simd: S) -> Tile<S, R, V> {
    [[simd.splat_f32s(0.0); V]; R]
}

/// `tile[r][p] + sum over k of left[k][r] right[k][p]`, p: the registers of `group`, each `V` of a [`Row`].
#[inline(always)]
pub(crate) fn product<S: Simd, const R: usize, const V: usize>(
    simd: S,
    mut tile: Tile<S, R, V>,
    left: &[[f32; R]],
    right: &[Row],
    group: usize,
) -> Tile<S, R, V> {
    for (left, right) in left.iter().zip(right) {
        let right = S::as_simd_f32s(right).0.as_chunks::<V>().0[group];
        for r in 0..R {
            let value = simd.splat_f32s(left[r]);
            for v in 0..V {
                tile[r][v] = multiply_add(simd, value, right[v], tile[r][v]);
            }
        }
    }
    tile
}

/// `tile[r][c] + sum over k < count of left[r][k] right[k][at + c]`, c: the lanes of `V` registers; `right` has
/// `stride` values a row.
#[inline(always)]
pub(crate) fn outer<S: Simd, const R: usize, const V: usize>(
    simd: S,
    mut tile: Tile<S, R, V>,
    left: &[Row; R],
    right: &[f32],
    (stride, at): (usize, usize),
    count: usize,
) -> Tile<S, R, V> {
    for (k, right) in right.chunks_exact(stride).take(count.min(PIXELS)).enumerate() {
        let right: [S::f32s; V] = S::as_simd_f32s(&right[at..at + V * S::F32_LANES]).0.as_chunks::<V>().0[0];
        for r in 0..R {
            let value = simd.splat_f32s(left[r][k % PIXELS]);
            for v in 0..V {
                tile[r][v] = multiply_add(simd, value, right[v], tile[r][v]);
            }
        }
    }
    tile
}
