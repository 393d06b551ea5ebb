//! Minimum of a function of a few parameters: the simplex method of Nelder and Mead (1965) with standard coefficients.

/// The best point found from `start` with first steps `steps`, and the value there.
pub fn minimise(start: &[f64], steps: &[f64], f: impl Fn(&[f64]) -> f64) -> (Vec<f64>, f64) {
    let n = start.len();
    if n == 0 {
        return (vec![], f(&[]));
    }
    let value = |p: &[f64]| {
        let v = f(p);
        if v.is_finite() { v } else { f64::MAX }
    };
    let mut points: Vec<(Vec<f64>, f64)> = (0..=n)
        .map(|i| {
            let mut p = start.to_vec();
            if i > 0 {
                p[i - 1] += steps[i - 1];
            }
            let v = value(&p);
            (p, v)
        })
        .collect();
    for _ in 0..200 * n {
        points.sort_by(|a, b| a.1.total_cmp(&b.1));
        if points[n].1 - points[0].1 <= 1e-9 * (1.0 + points[0].1.abs()) {
            break;
        }
        let center: Vec<f64> = (0..n).map(|k| points[..n].iter().map(|p| p.0[k]).sum::<f64>() / n as f64).collect();
        let towards = |t: f64| -> (Vec<f64>, f64) {
            let p: Vec<f64> = (0..n).map(|k| center[k] + t * (points[n].0[k] - center[k])).collect();
            let v = value(&p);
            (p, v)
        };
        let reflected = towards(-1.0);
        if reflected.1 < points[0].1 {
            let expanded = towards(-2.0);
            points[n] = if expanded.1 < reflected.1 { expanded } else { reflected };
        } else if reflected.1 < points[n - 1].1 {
            points[n] = reflected;
        } else {
            let contracted = if reflected.1 < points[n].1 { towards(-0.5) } else { towards(0.5) };
            if contracted.1 < points[n].1.min(reflected.1) {
                points[n] = contracted;
            } else {
                let best = points[0].0.clone();
                for p in &mut points[1..] {
                    for k in 0..n {
                        p.0[k] = best[k] + 0.5 * (p.0[k] - best[k]);
                    }
                    p.1 = value(&p.0);
                }
            }
        }
    }
    points.sort_by(|a, b| a.1.total_cmp(&b.1));
    points.swap_remove(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finds_the_valley() {
        let rosenbrock = |p: &[f64]| (1.0 - p[0]).powi(2) + 100.0 * (p[1] - p[0] * p[0]).powi(2);
        let (at, v) = minimise(&[-1.0, 1.0], &[0.3, 0.3], rosenbrock);
        assert!((at[0] - 1.0).abs() < 1e-3 && (at[1] - 1.0).abs() < 1e-3 && v < 1e-6, "{at:?}");
    }
}
