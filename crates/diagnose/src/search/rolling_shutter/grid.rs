//! Numbers of points on the simulation by the duration of a scan.

/// Counts on a grid of durations.
pub(super) struct Grid {
    /// All durations and the numbers of points in occupied cells.
    pub(super) sums: Vec<(f64, f64)>,
    /// Increase of that number on each frame, from no displacement to the best duration of other frames.
    pub(super) gains: Vec<f64>,
}

impl Grid {
    /// The duration with the most points in occupied cells.
    pub(super) fn best(&self) -> f64 {
        self.sums.iter().max_by(|a, b| a.1.total_cmp(&b.1)).map_or(0.0, |(at, _)| *at)
    }

    /// Smallest and largest number over all durations.
    pub(super) fn ends(&self) -> [f64; 2] {
        self.sums.iter().fold([f64::INFINITY, 0.0], |[low, high], (_, on)| [low.min(*on), high.max(*on)])
    }

    /// The highest local maximum among the durations that are `wanted`, and its number relative to the largest one.
    pub(super) fn highest(&self, wanted: impl Fn(f64) -> bool) -> Option<(f64, f64)> {
        let maxima = self.sums.windows(3).filter(|w| w[1].1 >= w[0].1 && w[1].1 >= w[2].1).map(|w| w[1]);
        let highest = maxima.filter(|(at, _)| wanted(*at)).max_by(|a, b| a.1.total_cmp(&b.1));
        highest.map(|(at, on)| (at, on / self.ends()[1].max(1.0)))
    }
}

/// The duration with the most points in occupied cells: the mean of the durations whose counts are within 15 % of the
/// best, in units of the difference between best and worst, weighted by what exceeds that.
pub(super) fn peak(times: &[f64], counts: &[Vec<f64>], which: &[usize]) -> f64 {
    let sums: Vec<f64> = (0..times.len()).map(|k| which.iter().map(|&i| counts[i][k]).sum()).collect();
    let [low, high] = [sums.iter().copied().fold(f64::INFINITY, f64::min), sums.iter().copied().fold(0.0, f64::max)];
    let weight = |s: f64| (s - (high - 0.15 * (high - low))).max(0.0);
    let total: f64 = sums.iter().map(|s| weight(*s)).sum();
    sums.iter().zip(times).map(|(s, t)| weight(*s) * t).sum::<f64>() / total.max(1e-9)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_highest_of_the_wanted_maxima_counts() {
        let counts = [5.0, 90.0, 60.0, 95.0, 94.0, 100.0, 97.0];
        let sums = (-3..=3).map(f64::from).zip(counts).collect();
        let grid = Grid { sums, gains: vec![] };
        assert_eq!((grid.best(), grid.ends()), (2.0, [5.0, 100.0]));
        assert_eq!(grid.highest(|_| true), Some((2.0, 1.0)));
        assert_eq!(grid.highest(|at| at < 1.5), Some((0.0, 0.95)));
        assert_eq!(grid.highest(|at| at < -0.5), Some((-2.0, 0.9)));
        assert_eq!(grid.highest(|at| at.abs() > 2.5), None);
    }
}
