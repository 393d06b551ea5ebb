//! Medians and quantiles. Values are ordered by `total_cmp`.

use std::cmp::Ordering;

/// A float that can be ordered.
pub trait Number: Copy {
    /// The total order of IEEE 754.
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

/// The median; of an even number of values the upper one of the two in the middle. `None` of nothing.
pub fn median_upper<T: Number>(mut values: Vec<T>) -> Option<T> {
    values.sort_by(Number::order);
    median_upper_of_sorted(&values)
}

/// [`median_upper`] of values that are in ascending order.
pub fn median_upper_of_sorted<T: Number>(sorted: &[T]) -> Option<T> {
    sorted.get(sorted.len() / 2).copied()
}

/// The first value, in ascending order, up to which at least half of the weight lies, of `(value, weight)`. `None` of nothing.
///
/// With equal weights and an even number of values this is the lower one of the two in the middle.
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

/// The value that a share of all does not exceed, linear between neighbours; NaN of nothing. For curves and intervals of reports.
pub fn quantile_linear(sorted: &[f64], share: f64) -> f64 {
    let Some(last) = sorted.len().checked_sub(1) else { return f64::NAN };
    let at = share.clamp(0.0, 1.0) * last as f64;
    let (low, part) = (at.floor() as usize, at.fract());
    sorted[low] + part * (sorted[(low + 1).min(last)] - sorted[low])
}

/// The central 95 % of drawn values: the drawn values nearest to the shares 0.025 and 0.975. `None` of nothing.
///
/// The ends are values that were drawn, unlike those of [`quantile_linear`].
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
