//! Minimum of a function of which value, gradient and an approximate curvature are known: the method of Levenberg
//! (1944) and Marquardt (1963).

use nalgebra::{DMatrix, DVector};

/// Gradient of a function at a point, and its curvature or a positive approximation of it.
pub struct Slopes {
    /// First derivatives.
    pub gradient: DVector<f64>,
    /// Second derivatives.
    pub curvature: DMatrix<f64>,
}

impl Slopes {
    /// All zero, of a function of `n` parameters.
    pub fn zeros(n: usize) -> Self {
        Slopes { gradient: DVector::zeros(n), curvature: DMatrix::zeros(n, n) }
    }

    /// Where a damped step leads. What is at a bound and would go beyond it stays.
    fn step(&self, damping: f64, at: &DVector<f64>, bounds: &[[f64; 2]]) -> Option<DVector<f64>> {
        let (mut curvature, mut gradient) = (self.curvature.clone(), self.gradient.clone());
        for (k, [low, high]) in bounds.iter().enumerate() {
            if at[k] <= *low && gradient[k] > 0.0 || at[k] >= *high && gradient[k] < 0.0 {
                curvature.row_mut(k).fill(0.0);
                curvature.column_mut(k).fill(0.0);
                gradient[k] = 0.0;
            }
            curvature[(k, k)] += damping * curvature[(k, k)].max(1e-6);
        }
        let step = curvature.cholesky()?.solve(&gradient);
        Some(DVector::from_fn(at.len(), |k, _| (at[k] - step[k]).clamp(bounds[k][0], bounds[k][1])))
    }
}

/// Most steps.
const STEPS: usize = 200;

/// A step that lowers the value by less is small.
const SMALL: f64 = 1e-5;

/// Small steps in a row after which the search ends.
const SMALL_STEPS: usize = 3;

/// Damping, in units of the curvature: at first, and where the search ends.
const DAMPING: [f64; 2] = [1e-3, 1e10];

/// The best point within `bounds` found from `start`, and the value there. A value that is not finite is none.
pub fn descend(
    start: DVector<f64>,
    bounds: &[[f64; 2]],
    value: impl Fn(&DVector<f64>) -> f64,
    slopes: impl Fn(&DVector<f64>) -> Slopes,
) -> (DVector<f64>, f64) {
    let (mut at, mut best) = (start.clone(), value(&start));
    let (mut damping, mut small) = (DAMPING[0], 0);
    let mut here = slopes(&at);
    for _ in 0..STEPS {
        let next = here.step(damping, &at, bounds).map(|next| (value(&next), next));
        match next.filter(|(v, _)| *v < best) {
            Some((lower, next)) => {
                small = if best - lower < SMALL { small + 1 } else { 0 };
                (at, best) = (next, lower);
                if small >= SMALL_STEPS {
                    break;
                }
                damping = (damping / 8.0).max(1e-12);
                here = slopes(&at);
            }
            None if damping > DAMPING[1] => break,
            None => damping *= 4.0,
        }
    }
    (at, best)
}

#[cfg(test)]
mod tests {
    use super::*;

    const FREE: [f64; 2] = [f64::NEG_INFINITY, f64::INFINITY];

    #[test]
    fn finds_the_end_of_a_bent_valley() {
        let parts = |p: &DVector<f64>| [1.0 - p[0], 10.0 * (p[1] - p[0] * p[0])];
        let value = |p: &DVector<f64>| parts(p).iter().map(|v| v * v).sum();
        let slopes = |p: &DVector<f64>| {
            let by = DMatrix::from_row_slice(2, 2, &[-1.0, 0.0, -20.0 * p[0], 10.0]);
            let parts = DVector::from_row_slice(&parts(p));
            Slopes { gradient: 2.0 * by.transpose() * parts, curvature: 2.0 * by.transpose() * &by }
        };
        let (at, v) = descend(DVector::from_row_slice(&[-1.0, 1.0]), &[FREE; 2], value, slopes);
        assert!((at[0] - 1.0).abs() < 1e-3 && (at[1] - 1.0).abs() < 1e-3 && v < 1e-6, "{at} {v}");
        // Within bounds, the lowest place of the valley.
        let bounds = [[-2.0, 0.5], FREE];
        let (at, v) = descend(DVector::from_row_slice(&[-1.0, 1.0]), &bounds, value, slopes);
        assert!(at[0] == 0.5 && (at[1] - 0.25).abs() < 1e-3 && (v - 0.25).abs() < 1e-5, "{at} {v}");
    }

    #[test]
    fn where_nothing_is_lower_it_stays() {
        let (at, v) = descend(DVector::from_element(1, 2.0), &[FREE], |_| f64::NAN, |_| Slopes::zeros(1));
        assert!(at[0] == 2.0 && v.is_nan());
    }
}
