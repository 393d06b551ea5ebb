//! Bootstrap percentile intervals, drawn from named random streams.

use data::stream;
use rand::RngExt;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

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
        let mut rng = stream(self.seed, purpose, 0, replicate as u64);
        let mut weights = vec![0; n_frames];
        let block = self.block_frames.clamp(1, n_frames.max(1));
        let mut left = n_frames;
        while left > 0 {
            let first = rng.random_range(0..n_frames);
            for i in 0..block.min(left) {
                weights[(first + i) % n_frames] += 1;
            }
            left -= block.min(left);
        }
        weights
    }

    /// Resamples `n` indices with replacement.
    pub(crate) fn draws(&self, purpose: &str, replicate: usize, n: usize) -> Vec<usize> {
        let mut rng = stream(self.seed, purpose, 0, replicate as u64);
        (0..n).map(|_| rng.random_range(0..n)).collect()
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
        Some(Interval { low: quantile(&values, outside), high: quantile(&values, 1.0 - outside) })
    }
}

/// Quantile with linear interpolation; NaN for an empty slice.
pub(crate) fn quantile(sorted: &[f64], share: f64) -> f64 {
    let Some(last) = sorted.len().checked_sub(1) else { return f64::NAN };
    let at = share.clamp(0.0, 1.0) * last as f64;
    let (low, part) = (at.floor() as usize, at.fract());
    sorted[low] + part * (sorted[(low + 1).min(last)] - sorted[low])
}

/// Arithmetic mean; NaN for an empty slice.
pub(crate) fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// Standard deviation with divisor n.
pub(crate) fn deviation(values: &[f64]) -> f64 {
    let center = mean(values);
    (values.iter().map(|v| (v - center) * (v - center)).sum::<f64>() / values.len() as f64).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_draw_has_as_many_frames() {
        for block_frames in [1, 7, 1000] {
            let options = BootstrapOptions { block_frames, ..BootstrapOptions::default() };
            let weights = options.frame_weights("test", 3, 100);
            assert_eq!(weights.iter().sum::<u32>(), 100);
            assert_eq!(weights, options.frame_weights("test", 3, 100));
            let all = block_frames >= 100; // every replicate then holds all frames once
            assert_eq!(weights == options.frame_weights("test", 4, 100), all);
        }
        assert!(BootstrapOptions::default().frame_weights("test", 0, 0).is_empty());
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
    fn quantiles_and_deviations() {
        assert_eq!(quantile(&[1.0, 2.0, 4.0], 0.75), 3.0);
        assert_eq!(quantile(&[5.0], 0.1), 5.0);
        assert!(quantile(&[], 0.5).is_nan());
        assert_eq!(deviation(&[1.0, 3.0]), 1.0);
        let options = BootstrapOptions::default();
        assert!(options.interval(vec![1.0; 5]).is_none());
        assert!(options.interval([vec![1.0; 30], vec![f64::NAN; 30]].concat()).is_none());
    }
}
