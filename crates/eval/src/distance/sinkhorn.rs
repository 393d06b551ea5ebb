//! Entropy-regularised earth mover's distance, by Sinkhorn's iteration.

use super::{DistanceError, Point, apart_m, check};
use rayon::prelude::*;

/// Sinkhorn divergence of two uniformly weighted clouds, m (Feydy et al. 2019): the regularised transport cost of (a,
/// b) minus half the costs of (a, a) and (b, b), so that equal clouds have distance 0. The ground cost is the
/// Euclidean distance, as in [`super::emd`], which is the limit for `epsilon_m` -> 0. Sizes may differ.
///
/// # Errors
/// An empty cloud or a non-finite position.
pub fn sinkhorn(a: &[Point], b: &[Point], epsilon_m: f64, iterations: usize) -> Result<f64, DistanceError> {
    check(a)?;
    check(b)?;
    let cost = |a: &[Point], b: &[Point]| regularised(a, b, epsilon_m, iterations);
    Ok(cost(a, b) - (cost(a, a) + cost(b, b)) / 2.0)
}

/// Dual value: mean of the potentials of both clouds after at most `iterations` log-domain iterations, or at
/// convergence.
fn regularised(a: &[Point], b: &[Point], epsilon_m: f64, iterations: usize) -> f64 {
    let (mut f, mut g) = (vec![0.0; a.len()], vec![0.0; b.len()]);
    for _ in 0..iterations {
        // Averages old and new potentials: with a = b, the plain iteration oscillates.
        let (next_f, next_g) = (potentials(a, b, &g, epsilon_m), potentials(b, a, &f, epsilon_m));
        let mut moved = 0.0f64;
        for (old, new) in f.iter_mut().zip(next_f).chain(g.iter_mut().zip(next_g)) {
            let middle = (*old + new) / 2.0;
            moved = moved.max((middle - *old).abs());
            *old = middle;
        }
        if moved < 1e-6 * epsilon_m {
            break;
        }
    }
    f.iter().sum::<f64>() / a.len() as f64 + g.iter().sum::<f64>() / b.len() as f64
}

/// Optimal potentials of `from` given the potentials of `to`: -epsilon log mean exp((g - cost) / epsilon).
fn potentials(from: &[Point], to: &[Point], g: &[f64], epsilon_m: f64) -> Vec<f64> {
    let one = |p: &Point| {
        let gain = |(q, g): (&Point, &f64)| (g - apart_m(p, q)) / epsilon_m;
        let gains: Vec<f64> = to.iter().zip(g).map(gain).collect();
        let highest = gains.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let mean = gains.iter().map(|v| (v - highest).exp()).sum::<f64>() / to.len() as f64;
        -epsilon_m * (highest + mean.ln())
    };
    from.par_iter().map(one).collect()
}

#[cfg(test)]
mod tests {
    use super::super::emd;
    use super::*;
    use data::stream;
    use rand::RngExt;

    #[test]
    fn is_near_the_exact_distance_and_zero_for_equal_clouds() {
        let mut rng = stream(1, "sinkhorn test", 0, 0);
        let a: Vec<Point> = (0..64).map(|_| [0; 3].map(|_: i32| rng.random_range(-5.0..5.0))).collect();
        let b: Vec<Point> = a.iter().map(|p| [p[0] + 2.0, p[1] * 1.1, p[2] - 1.0]).collect();
        let exact = emd(&a, &b).unwrap();
        let near = sinkhorn(&a, &b, 0.05, 500).unwrap();
        assert!((near - exact).abs() < 0.05 * exact, "{near} instead of {exact}");
        assert!(sinkhorn(&a, &a, 0.5, 200).unwrap().abs() < 1e-6);
        assert!(sinkhorn(&a, &b[..40], 0.5, 100).unwrap() > 0.5);
    }
}
