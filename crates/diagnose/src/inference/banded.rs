//! Symmetric matrices that are zero beyond some diagonals.

/// A factor `L` of a positive definite matrix `L L'`, zero beyond some diagonals below the main one.
pub struct Cholesky {
    /// Of each row the elements up to the main diagonal, from the first one that may not be zero.
    rows: Vec<Vec<f64>>,
}

impl Cholesky {
    /// Factors a matrix of `n` rows; `element` gives its elements on the main diagonal and on `below` diagonals under
    /// it. `None` where the matrix is not positive definite.
    pub fn new(n: usize, below: usize, element: impl Fn(usize, usize) -> f64) -> Option<Cholesky> {
        let mut rows: Vec<Vec<f64>> = Vec::with_capacity(n);
        for i in 0..n {
            let first = i.saturating_sub(below);
            let mut row: Vec<f64> = Vec::with_capacity(i - first + 1);
            for j in first..i {
                let from = j.saturating_sub(below).max(first);
                let other = &rows[j];
                let product = dot(&row[from - first..], &other[other.len() - 1 - (j - from)..]);
                row.push((element(i, j) - product) / other[other.len() - 1]);
            }
            let square = element(i, i) - dot(&row, &row);
            if square.is_nan() || square <= 0.0 {
                return None;
            }
            row.push(square.sqrt());
            rows.push(row);
        }
        Some(Cholesky { rows })
    }

    /// Logarithm of the determinant of the matrix.
    pub fn ln_determinant(&self) -> f64 {
        2.0 * self.rows.iter().map(|row| row[row.len() - 1].ln()).sum::<f64>()
    }

    /// Solution for a right side.
    pub fn solve(&self, right: &[f64]) -> Vec<f64> {
        let mut x = right.to_vec();
        for (i, row) in self.rows.iter().enumerate() {
            let last = row.len() - 1;
            x[i] = (x[i] - dot(&row[..last], &x[i - last..i])) / row[last];
        }
        for (i, row) in self.rows.iter().enumerate().rev() {
            let last = row.len() - 1;
            x[i] /= row[last];
            let own = x[i];
            x[i - last..i].iter_mut().zip(row).for_each(|(x, l)| *x -= l * own);
        }
        x
    }
}

/// Sum of the products of two lists, as far as the shorter one goes.
fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{DMatrix, DVector};
    use rand::RngExt;

    #[test]
    fn it_solves_what_a_full_matrix_solves() {
        let mut rng = data::stream(3, "banded", 0, 0);
        for (n, below) in [(1, 0), (1, 4), (5, 0), (7, 2), (12, 11), (30, 5)] {
            let root =
                DMatrix::from_fn(n, n, |i, j| if j <= i && i - j <= below { rng.random_range(0.5..1.5) } else { 0.0 });
            let full = &root * root.transpose();
            let right = DVector::from_fn(n, |_, _| rng.random_range(-1.0..1.0));
            let banded = Cholesky::new(n, below, |i, j| full[(i, j)]).unwrap();
            let expected = full.clone().cholesky().unwrap();
            assert!((banded.ln_determinant() - expected.ln_determinant()).abs() < 1e-9, "{n} {below}");
            let (own, theirs) = (banded.solve(right.as_slice()), expected.solve(&right));
            let scale = theirs.amax().max(1.0);
            assert!(own.iter().zip(theirs.iter()).all(|(a, b)| (a - b).abs() < 1e-8 * scale), "{n} {below}");
        }
        assert!(Cholesky::new(2, 1, |i, j| if i == j { 1.0 } else { 2.0 }).is_none());
        assert!(Cholesky::new(1, 0, |_, _| f64::NAN).is_none());
    }
}
