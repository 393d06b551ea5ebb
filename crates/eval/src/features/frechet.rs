//! Fréchet distance of two feature sets, modelled as normal distributions (as in FID; Heusel et al. 2017).

use super::{FeatureError, Features};
use nalgebra::{DMatrix, SymmetricEigen};

/// |mean difference|² + trace(A + B - 2 (AB)^1/2), with the covariances A and B (divisor n - 1), in squared feature
/// units. The samples need not be the same. Biased upwards if there are few samples per feature: compare with the
/// distance between two halves of one set.
///
/// # Errors
/// Vectors of different length, or fewer than two samples.
pub fn frechet_distance(a: &Features, b: &Features) -> Result<f64, FeatureError> {
    if a.dim() != b.dim() {
        return Err(FeatureError::Values(format!("vectors of {} and of {} values", a.dim(), b.dim())));
    }
    for n in [a.len(), b.len()] {
        if n < 2 {
            return Err(FeatureError::TooFew { what: "a Fréchet distance", least: 2, n });
        }
    }
    let ((x, mean_x), (y, mean_y)) = (a.centered(), b.centered());
    let covariance = |x: &DMatrix<f64>| x.tr_mul(x) / (x.nrows() - 1) as f64;
    let (cov_a, cov_b) = (covariance(&x), covariance(&y));
    let apart: f64 = mean_x.iter().zip(&mean_y).map(|(p, q)| (p - q) * (p - q)).sum();
    // (AB)^1/2 has the same trace as (A^1/2 B A^1/2)^1/2, which is symmetric.
    let root = square_root(&cov_a);
    let middle = &root * &cov_b * &root;
    let middle = (&middle + middle.transpose()) / 2.0;
    let shared: f64 = middle.symmetric_eigenvalues().iter().map(|v| v.max(0.0).sqrt()).sum();
    Ok((apart + cov_a.trace() + cov_b.trace() - 2.0 * shared).max(0.0))
}

fn square_root(covariance: &DMatrix<f64>) -> DMatrix<f64> {
    let SymmetricEigen { eigenvectors, eigenvalues } = SymmetricEigen::new(covariance.clone());
    let roots = DMatrix::from_diagonal(&eigenvalues.map(|v| v.max(0.0).sqrt()));
    &eigenvectors * roots * eigenvectors.transpose()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_independent_columns_it_is_the_sum_of_their_own() {
        // Two uncorrelated columns: the distance is the sum over columns of the mean and deviation terms.
        let signs = [[-1.0f32, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]];
        let set = |scale: [f32; 2], mean: [f32; 2]| {
            let values = signs.iter().flat_map(|s| [s[0] * scale[0] + mean[0], s[1] * scale[1] + mean[1]]);
            Features::new(2, values.collect()).unwrap()
        };
        let (a, b) = (set([1.0, 2.0], [0.0, 0.0]), set([3.0, 5.0], [1.0, -2.0]));
        let spread = 4.0 / 3.0; // sum of squares divided by n - 1
        let want = 5.0 + spread * (2.0 * 2.0 + 3.0 * 3.0);
        assert!((frechet_distance(&a, &b).unwrap() - want).abs() < 1e-9);
        assert!(frechet_distance(&a, &a).unwrap() < 1e-9);
        assert!(frechet_distance(&a, &Features::new(1, vec![0.0; 4]).unwrap()).is_err());
    }
}
