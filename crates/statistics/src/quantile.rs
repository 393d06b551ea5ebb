//! Medians and quantiles. Values are sorted by `total_cmp`.

use std::cmp::Ordering;

/// A floating-point number with a total order.
pub trait Number: Copy {
    /// Compares by the total order of IEEE 754.
    fn order(&self, other: &Self) -> Ordering;
}

impl Number for f64 {
    fn order(&self, other: &f64) -> Ordering {
        self.total_cmp(other)
    }
}

impl Number for f32 {
    fn order(&self, other: &f32) -> Ordering {
        self.total_cmp(other)
    }
}

/// The median; for an even number of values the upper of the two middle values. `None` without values.
pub fn median_upper<T: Number>(mut values: Vec<T>) -> Option<T> {
    values.sort_by(Number::order);
    median_upper_of_sorted(&values)
}

/// [`median_upper`] of values in ascending order.
pub fn median_upper_of_sorted<T: Number>(sorted: &[T]) -> Option<T> {
    sorted.get(sorted.len() / 2).copied()
}

/// Weighted median of `(value, weight)`: the smallest value whose cumulative weight is at least half of the total
/// weight. `None` without values.
///
/// With equal weights and an even number of values this is the lower of the two middle values.
pub fn weighted_median(mut values: Vec<(f64, f64)>) -> Option<f64> {
    values.sort_by(|a, b| a.0.total_cmp(&b.0));
    let half = values.iter().map(|v| v.1).sum::<f64>() / 2.0;
    let mut below = 0.0;
    let found = values.iter().find(|(_, weight)| {
        below += weight;
        below >= half
    });
    found.map(|v| v.0)
}

/// Quantile of values in ascending order with linear interpolation (NumPy's default method). `share` is clamped to
/// `[0, 1]`. NaN without values.
pub fn quantile_linear(sorted: &[f64], share: f64) -> f64 {
    let Some(last) = sorted.len().checked_sub(1) else { return f64::NAN };
    let at = share.clamp(0.0, 1.0) * last as f64;
    let (low, part) = (at.floor() as usize, at.fract());
    sorted[low] + part * (sorted[(low + 1).min(last)] - sorted[low])
}

/// 95 % percentile interval of bootstrap replicates: the values nearest to the quantiles 0.025 and 0.975. `None`
/// without values.
///
/// Unlike [`quantile_linear`] it does not interpolate: both bounds are values of `drawn`.
pub fn interval_nearest(mut drawn: Vec<f64>) -> Option<[f64; 2]> {
    drawn.sort_by(f64::total_cmp);
    let last = drawn.len().checked_sub(1)? as f64;
    Some([0.025, 0.975].map(|share| drawn[(last * share).round() as usize]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn medians() {
        assert_eq!(median_upper(vec![3.0, 1.0, 2.0]), Some(2.0));
        assert_eq!(median_upper(vec![4.0_f32, 1.0, 2.0, 3.0]), Some(3.0));
        assert_eq!(median_upper::<f64>(vec![]), None);
        assert_eq!(weighted_median(vec![(4.0, 1.0), (1.0, 1.0), (2.0, 1.0), (3.0, 1.0)]), Some(2.0));
        assert_eq!(weighted_median(vec![(1.0, 1.0), (2.0, 5.0), (3.0, 1.0)]), Some(2.0));
        assert_eq!(weighted_median(vec![]), None);
    }

    #[test]
    fn quantiles() {
        assert_eq!(quantile_linear(&[1.0, 2.0, 4.0], 0.75), 3.0);
        assert_eq!(quantile_linear(&[5.0], 0.1), 5.0);
        assert!(quantile_linear(&[], 0.5).is_nan());
        assert_eq!(interval_nearest((0..=100).rev().map(f64::from).collect()), Some([3.0, 98.0]));
        assert_eq!(interval_nearest(vec![7.0]), Some([7.0, 7.0]));
        assert_eq!(interval_nearest(vec![]), None);
    }
}
