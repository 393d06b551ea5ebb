//! Range-dependent dropout that matches the range distribution of another data set: the "distribution-matched"
//! downsampling of Huch et al. 2023.

use crate::effects::RangeDropout;
use data::{Cloud, DataError, Dataset};
use rayon::prelude::*;

/// Width of a range bin, m.
pub const BIN_M: f64 = 5.0;
/// Larger ranges are counted in the last bin, m.
const FARTHEST_M: f64 = 150.0;

/// Histogram of ranges from the cloud origin, in bins of [`BIN_M`].
#[derive(Clone, Debug, PartialEq, Default)]
pub struct RangeHistogram {
    counts: Vec<u64>,
}

impl RangeHistogram {
    /// Adds the points of a cloud.
    pub fn add(&mut self, cloud: &Cloud) {
        let bins = (FARTHEST_M / BIN_M) as usize;
        self.counts.resize(bins, 0);
        for p in cloud.points() {
            let range_m = f64::from(p[0]).hypot(p[1].into()).hypot(p[2].into());
            self.counts[((range_m / BIN_M) as usize).min(bins - 1)] += 1;
        }
    }

    fn sum(mut self, other: RangeHistogram) -> RangeHistogram {
        self.counts.resize(self.counts.len().max(other.counts.len()), 0);
        self.counts.iter_mut().zip(other.counts).for_each(|(a, b)| *a += b);
        self
    }

    /// Histogram of these frames of a data set.
    pub fn of_dataset(dataset: &Dataset, ids: &[String]) -> Result<RangeHistogram, DataError> {
        let count = |id: &String| {
            let mut histogram = RangeHistogram::default();
            histogram.add(&dataset.load_cloud(id)?);
            Ok(histogram)
        };
        ids.par_iter().map(count).try_reduce(RangeHistogram::default, |a, b| Ok(a.sum(b)))
    }
}

/// The range dropout that reduces `simulated` to the point counts of `measured`; 0 in bins where `measured` has more
/// points. Both histograms must be over the same frames.
pub fn fit_range_dropout(measured: &RangeHistogram, simulated: &RangeHistogram) -> RangeDropout {
    let share = |i: usize| {
        let (m, s) = (measured.counts.get(i).copied().unwrap_or(0) as f64, simulated.counts[i] as f64);
        if s > 0.0 { (1.0 - m / s).clamp(0.0, 1.0) } else { 0.0 }
    };
    let used = simulated.counts.iter().rposition(|n| *n > 0).map_or(1, |last| last + 1);
    RangeDropout {
        range_m: (0..used).map(|i| (i as f64 + 0.5) * BIN_M).collect(),
        share: (0..used).map(|i| if i < simulated.counts.len() { share(i) } else { 0.0 }).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::effects::SensorEffect;
    use crate::effects::testing::applied;
    use crate::scan::{Echo, Scan};

    /// Points at all ranges up to 100 m, less than half of them beyond 50 m.
    fn clouds() -> (Scan, Scan) {
        let at = |range_m: f32| Echo { range_m, ..Echo::nothing([0.0; 3], [1.0, 0.0, 0.0]) };
        let all: Vec<Echo> = (0..100_000).map(|i| at(i as f32 * 1e-3)).collect();
        let thinned = all.iter().enumerate().filter(|(i, e)| e.range_m < 50.0 || i % 5 < 2).map(|(_, e)| *e).collect();
        (Scan { echoes: all }, Scan { echoes: thinned })
    }

    #[test]
    fn the_dropout_matches_the_range_distribution() {
        let (simulated, measured) = clouds();
        let histogram = |scan: &Scan| {
            let mut histogram = RangeHistogram::default();
            histogram.add(&scan.cloud());
            histogram
        };
        let effect = fit_range_dropout(&histogram(&measured), &histogram(&simulated));
        effect.check().unwrap();
        assert!(effect.share_at(20.0).abs() < 1e-9 && (effect.share_at(80.0) - 0.6).abs() < 0.01);
        let after = histogram(&applied(&effect, &simulated));
        let want = histogram(&measured);
        for i in 0..20 {
            // At 50 m the table has a linear ramp between two bins.
            let tolerance = if (9..=10).contains(&i) { 0.5 } else { 0.05 };
            assert!((after.counts[i] as f64 / want.counts[i] as f64 - 1.0).abs() < tolerance, "bin {i}");
        }
    }

    #[test]
    fn nothing_is_added_where_more_was_measured() {
        let (all, thinned) = clouds();
        let (mut a, mut b) = (RangeHistogram::default(), RangeHistogram::default());
        a.add(&all.cloud());
        b.add(&thinned.cloud());
        assert!(fit_range_dropout(&a, &b).share.iter().all(|s| *s == 0.0));
        assert_eq!(fit_range_dropout(&a, &RangeHistogram::default()).share, [0.0]);
    }
}
