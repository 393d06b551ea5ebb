//! Products of matrices in slices, with the crate `gemm` on one thread.

/// A strided matrix in a slice.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Matrix<'a> {
    values: &'a [f32],
    rows: usize,
    columns: usize,
    row_stride: usize,
    column_stride: usize,
}

impl<'a> Matrix<'a> {
    /// `[rows, columns]`, row-major; the number of rows follows from the number of values.
    pub fn new(values: &'a [f32], columns: usize) -> Self {
        let rows = values.len() / columns.max(1);
        assert_eq!(rows * columns, values.len(), "whole rows of {columns} values");
        Matrix { values, rows, columns, row_stride: columns, column_stride: 1 }
    }

    /// `[rows, columns]` with `row_stride` values from row to row.
    pub fn window(values: &'a [f32], rows: usize, columns: usize, row_stride: usize) -> Self {
        let needed = if rows == 0 { 0 } else { (rows - 1) * row_stride + columns };
        assert!(columns <= row_stride && values.len() >= needed, "{rows} rows of {columns} values");
        Matrix { values, rows, columns, row_stride, column_stride: 1 }
    }

    /// The transposed matrix.
    pub fn transposed(self) -> Self {
        let Matrix { rows, columns, row_stride, column_stride, .. } = self;
        Matrix { rows: columns, columns: rows, row_stride: column_stride, column_stride: row_stride, ..self }
    }
}

/// Whether the product replaces or is added to the output.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Then {
    /// Overwrite the output.
    Store,
    /// Add to the output.
    Add,
}

/// `a b` into `out`, `[rows of a, columns of b]`, row-major.
pub(crate) fn multiply(a: Matrix<'_>, b: Matrix<'_>, out: &mut [f32], then: Then) {
    assert_eq!(a.columns, b.rows, "columns of the left factor and rows of the right");
    assert_eq!(out.len(), a.rows * b.columns, "elements of the product");
    if a.columns == 0 && then == Then::Store {
        out.fill(0.0);
    }
    if out.is_empty() || a.columns == 0 {
        return;
    }
    // SAFETY: `Matrix::new`, `window` and `transposed` keep all elements of the factors inside their slices. `out` is
    // row-major and has the size of the product, and a mutable slice overlaps no other.
    unsafe {
        gemm::gemm(
            a.rows,
            b.columns,
            a.columns,
            out.as_mut_ptr(),
            1,
            b.columns as isize,
            then == Then::Add,
            a.values.as_ptr(),
            a.column_stride as isize,
            a.row_stride as isize,
            b.values.as_ptr(),
            b.column_stride as isize,
            b.row_stride as isize,
            1.0,
            1.0,
            false,
            false,
            false,
            gemm::Parallelism::None,
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reference::{assert_close, random};

    #[test]
    fn equals_the_definition() {
        for (m, k, n) in [(1, 1, 1), (7, 3, 5), (40, 33, 17), (3, 0, 2), (0, 2, 2)] {
            let (a, b) = (random(m * k, 1), random(k * n, 2));
            let mut want = vec![0.0; m * n];
            for (i, want) in want.iter_mut().enumerate() {
                *want = (0..k).map(|l| a[i / n * k + l] as f64 * b[l * n + i % n] as f64).sum();
            }
            let transpose = |v: &[f32], columns: usize| -> Vec<f32> {
                let rows = v.len() / columns.max(1);
                (0..v.len()).map(|i| v[i % rows * columns + i / rows]).collect()
            };
            let (a_t, b_t) = (transpose(&a, k), transpose(&b, n));
            if k == 0 {
                continue;
            }
            let mut out = vec![f32::NAN; m * n];
            for left in [Matrix::new(&a, k), Matrix::new(&a_t, m).transposed()] {
                for right in [Matrix::new(&b, n), Matrix::new(&b_t, k).transposed()] {
                    if m == 0 {
                        continue;
                    }
                    multiply(left, right, &mut out, Then::Store);
                    assert_close(&out, &want, 1e-6, "product");
                }
            }
            let twice: Vec<f64> = want.iter().map(|v| 2.0 * v).collect();
            multiply(Matrix::new(&a, k), Matrix::new(&b, n), &mut out[..m * n], Then::Add);
            assert_close(&out, &twice, 1e-6, "sum of products");
        }
    }
}
