//! Bootstrap percentile intervals, drawn from named random streams.

use data::stream;
use rand::RngExt;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use statistics::{draw, draw_runs, quantile_linear};

/// Bootstrap settings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct BootstrapOptions {
    /// Number of replicates; 0: no intervals.
    pub replicates: usize,
    /// Confidence level, 0 to 1.
    pub level: f64,
    /// Random seed.
    pub seed: u64,
    /// Block length: frames are resampled in blocks of this many consecutive frames. Consecutive frames of a drive are
    /// correlated; resampling single frames (1) gives intervals that are too narrow.
    pub block_frames: usize,
}

impl Default for BootstrapOptions {
    fn default() -> Self {
        BootstrapOptions { replicates: 1000, level: 0.95, seed: 0, block_frames: 1 }
    }
}

/// A confidence interval.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Interval {
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

impl BootstrapOptions {
    /// How often each of `n_frames` frames is drawn in a replicate. Equal purposes give equal draws, so comparisons on
    /// the same frames use the same resamples.
    pub(crate) fn frame_weights(&self, purpose: &str, replicate: usize, n_frames: usize) -> Vec<u32> {
        draw_runs(n_frames, self.block_frames, &mut stream(self.seed, purpose, 0, replicate as u64))
    }

    /// Draws `n - 1` of `n` seeds with replacement (one if there is one). With `n` draws the variance of the mean of
    /// few seeds would come out too small by `(n - 1) / n`: half of it with two seeds (Rao and Wu 1988).
    pub(crate) fn seed_draws(&self, purpose: &str, replicate: usize, n: usize) -> Vec<usize> {
        let mut drawn = self.draws(purpose, replicate, n);
        drawn.truncate(n.saturating_sub(1).max(1));
        drawn
    }

    /// Which version of boxes that are known with an interval a replicate uses: the estimate (0) in two of three
    /// replicates, each end (1, 2) in one of six. With ends the square root of three standard errors apart from the
    /// estimate, mean and variance of the versions are those of the estimate. The same for all cells, which share a
    /// correction.
    pub(crate) fn version_draw(&self, replicate: usize) -> usize {
        match stream(self.seed, "matrix versions of boxes", 0, replicate as u64).random_range(0..6) {
            end @ 1..=2 => end,
            _ => 0,
        }
    }

    /// Resamples `n` indices with replacement.
    pub(crate) fn draws(&self, purpose: &str, replicate: usize, n: usize) -> Vec<usize> {
        draw(n, &mut stream(self.seed, purpose, 0, replicate as u64))
    }

    /// Percentile interval at `level`. `None` with fewer than 20 defined values, or if more than 5 % are undefined
    /// (NaN).
    pub(crate) fn interval(&self, mut values: Vec<f64>) -> Option<Interval> {
        let all = values.len();
        values.retain(|v| !v.is_nan());
        if values.len() < 20 || (all - values.len()) * 20 > all {
            return None;
        }
        values.sort_by(f64::total_cmp);
        let outside = (1.0 - self.level) / 2.0;
        Some(Interval { low: quantile_linear(&values, outside), high: quantile_linear(&values, 1.0 - outside) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use statistics::mean;

    #[test]
    fn equal_purposes_draw_alike() {
        let options = BootstrapOptions { block_frames: 7, ..BootstrapOptions::default() };
        let weights = options.frame_weights("test", 3, 100);
        assert_eq!(weights, options.frame_weights("test", 3, 100));
        assert_ne!(weights, options.frame_weights("test", 4, 100));
    }

    #[test]
    fn intervals_cover_the_mean_as_often_as_they_say() {
        let options = BootstrapOptions { replicates: 400, level: 0.9, ..BootstrapOptions::default() };
        let mut covered = 0;
        for k in 0..200 {
            let mut rng = stream(k, "bootstrap test", 0, 0);
            let values: Vec<f64> = (0..60).map(|_| rng.random_range(0.0..1.0)).collect();
            let means = (0..options.replicates)
                .map(|r| mean(&options.draws("m", r, 60).iter().map(|i| values[*i]).collect::<Vec<_>>()))
                .collect();
            let interval = options.interval(means).unwrap();
            covered += usize::from(interval.low <= 0.5 && 0.5 <= interval.high);
        }
        assert!((165..=195).contains(&covered), "{covered} of 200 at 90 %");
    }

    #[test]
    fn few_seeds_have_the_variance_of_their_mean() {
        let options = BootstrapOptions { replicates: 4000, ..BootstrapOptions::default() };
        let values = [1.0, 4.0, 4.0];
        let means: Vec<f64> = (0..options.replicates)
            .map(|r| mean(&options.seed_draws("seeds", r, 3).iter().map(|i| values[*i]).collect::<Vec<_>>()))
            .collect();
        let center = mean(&means);
        let variance = mean(&means.iter().map(|m| (m - center).powi(2)).collect::<Vec<_>>());
        // Deviation with divisor n - 1, over the square root of n: 3 / 3 = 1.
        assert!((variance - 1.0).abs() < 0.06, "{variance}");
        assert_eq!(options.seed_draws("seeds", 0, 1), [0]);
    }

    #[test]
    fn versions_have_the_variance_of_the_estimate() {
        let options = BootstrapOptions::default();
        let offsets = [0.0, -(3f64.sqrt()), 3f64.sqrt()];
        let drawn: Vec<f64> = (0..6000).map(|r| offsets[options.version_draw(r)]).collect();
        let variance = mean(&drawn.iter().map(|v| v * v).collect::<Vec<_>>());
        assert!(mean(&drawn).abs() < 0.05 && (variance - 1.0).abs() < 0.06, "{variance}");
    }

    #[test]
    fn few_or_undefined_values_have_no_interval() {
        let options = BootstrapOptions::default();
        assert!(options.interval(vec![1.0; 5]).is_none());
        assert!(options.interval([vec![1.0; 30], vec![f64::NAN; 30]].concat()).is_none());
    }
}
