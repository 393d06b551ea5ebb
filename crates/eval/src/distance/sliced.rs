//! Sliced Wasserstein distance.

use super::{DistanceError, Point, check};
use data::stream;
use rand::RngExt;
use rayon::prelude::*;

/// Mean over projection directions of the 1D Wasserstein-1 distance of the projected clouds, m. Directions are uniform
/// on the sphere, drawn from `seed`. Clouds may differ in size; the points of a cloud have equal weights.
///
/// # Errors
/// An empty cloud or a non-finite position.
pub fn sliced_wasserstein(a: &[Point], b: &[Point], directions: usize, seed: u64) -> Result<f64, DistanceError> {
    check(a)?;
    check(b)?;
    let of_direction = |k: usize| {
        let mut rng = stream(seed, "sliced wasserstein", 0, k as u64);
        let (up, around): (f64, f64) = (rng.random_range(-1.0..1.0), rng.random_range(0.0..std::f64::consts::TAU));
        let out = (1.0 - up * up).sqrt();
        let along = [out * around.cos(), out * around.sin(), up];
        let shadow = |cloud: &[Point]| {
            let mut shadow: Vec<f64> = cloud.iter().map(|p| (0..3).map(|k| f64::from(p[k]) * along[k]).sum()).collect();
            shadow.sort_unstable_by(f64::total_cmp);
            shadow
        };
        wasserstein_1(&shadow(a), &shadow(b))
    };
    let distances: Vec<f64> = (0..directions).into_par_iter().map(of_direction).collect();
    Ok(distances.iter().sum::<f64>() / directions as f64)
}

/// Area between the two quantile functions.
fn wasserstein_1(a: &[f64], b: &[f64]) -> f64 {
    let (n, m) = (a.len(), b.len());
    let (mut i, mut j, mut at, mut area) = (0, 0, 0u64, 0.0);
    let whole = n as u64 * m as u64; // in units of 1 / (n m): steps of a are m wide, steps of b n
    while at < whole {
        let (end_a, end_b) = ((i as u64 + 1) * m as u64, (j as u64 + 1) * n as u64);
        let end = end_a.min(end_b);
        area += (end - at) as f64 * (a[i] - b[j]).abs();
        (i, j, at) = (i + usize::from(end == end_a), j + usize::from(end == end_b), end);
    }
    area / whole as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn on_a_line_it_is_the_area_between_the_quantiles() {
        assert_eq!(wasserstein_1(&[0.0, 1.0], &[2.0, 3.0]), 2.0);
        assert_eq!(wasserstein_1(&[0.0], &[0.0, 3.0, 3.0]), 2.0);
        assert_eq!(wasserstein_1(&[0.0, 4.0], &[1.0, 2.0, 3.0]), (1.0 * 2.0 + 2.0 + 2.0 + 2.0) / 6.0);
    }

    #[test]
    fn a_shift_gives_half_its_length() {
        // The mean of |cos| over the sphere is 1/2.
        let a: Vec<Point> = (0..500).map(|i| [(i % 10) as f32, (i / 10) as f32, 0.0]).collect();
        let b: Vec<Point> = a.iter().map(|p| [p[0], p[1] + 3.0, p[2]]).collect();
        let d = sliced_wasserstein(&a, &b, 4000, 1).unwrap();
        assert!((d - 1.5).abs() < 0.05, "{d}");
        assert_eq!(sliced_wasserstein(&a, &a, 10, 1).unwrap(), 0.0);
    }
}
