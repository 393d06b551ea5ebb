//! Earth mover's distance: exact, by assignment.

use super::{DistanceError, Point, apart_m, check};

/// Mean distance that the points of `a` have to be moved to become `b`, each one to another place, at best; m. Exact: the cheapest of
/// all assignments (Jonker and Volgenant, crate `lapjv`). Time grows with the third power of the number of points: a few thousand at most.
///
/// # Errors
/// Clouds of different size, without a point, or with a position that is not finite.
pub fn emd(a: &[Point], b: &[Point]) -> Result<f64, DistanceError> {
    check(a)?;
    check(b)?;
    if a.len() != b.len() {
        return Err(DistanceError::Sizes { a: a.len(), b: b.len() });
    }
    let n = a.len();
    let failed = |message: String| DistanceError::Assignment { n, message };
    let costs = a.iter().flat_map(|p| b.iter().map(|q| apart_m(p, q))).collect();
    let costs = lapjv::Matrix::from_shape_vec((n, n), costs).map_err(|e| failed(e.to_string()))?;
    let (columns, _) = lapjv::lapjv(&costs).map_err(|e| failed(e.to_string()))?;
    Ok(lapjv::cost(&costs, &columns) / n as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use data::stream;
    use rand::RngExt;

    /// The cheapest of all permutations, by trying them.
    fn tried(a: &[Point], b: &[Point], used: &mut Vec<bool>, k: usize) -> f64 {
        if k == a.len() {
            return 0.0;
        }
        let mut best = f64::INFINITY;
        for j in 0..b.len() {
            if !used[j] {
                used[j] = true;
                best = best.min(apart_m(&a[k], &b[j]) + tried(a, b, used, k + 1));
                used[j] = false;
            }
        }
        best
    }

    #[test]
    fn is_the_cheapest_of_all_permutations() {
        for seed in 0..30 {
            let mut rng = stream(seed, "emd test", 0, 0);
            let n = rng.random_range(1..8);
            let mut cloud =
                || -> Vec<Point> { (0..n).map(|_| [0; 3].map(|_: i32| rng.random_range(-3..3) as f32)).collect() };
            let (a, b) = (cloud(), cloud());
            let want = tried(&a, &b, &mut vec![false; n], 0) / n as f64;
            assert!((emd(&a, &b).unwrap() - want).abs() < 1e-9, "seed {seed}");
        }
    }

    #[test]
    fn a_shift_costs_its_length() {
        let a: Vec<Point> = (0..300).map(|i| [i as f32 * 0.1, (i % 7) as f32, 0.0]).collect();
        let b: Vec<Point> = a.iter().rev().map(|p| [p[0], p[1], p[2] + 0.25]).collect();
        assert!((emd(&a, &b).unwrap() - 0.25).abs() < 1e-6);
        assert!(matches!(emd(&a, &b[1..]), Err(DistanceError::Sizes { .. })));
    }
}
