//! How well a twin agrees with the recording it was made of, shot by shot.

use crate::world::FrameShots;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Sums over shots.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Agreement {
    /// Absolute range differences, in bins of 1 mm up to 1 m; the last bin has the rest.
    bins: Vec<u64>,
    measured: u64,
    met: u64,
    shown: u64,
    shown_met: u64,
}

/// Bins of [`Agreement`], per m.
const BINS_PER_M: f32 = 1000.0;

/// An [`Agreement`] in numbers. Shares are 0 to 1.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct AgreementNumbers {
    /// Recorded returns.
    pub measured_returns: u64,
    /// Share of the recorded returns whose shot returns in the twin.
    pub met_share: f64,
    /// Returns of the twin.
    pub twin_returns: u64,
    /// Share of the twin's returns whose shot returned in the recording.
    pub twin_met_share: f64,
    /// Median of the absolute range differences of shots that return on both sides, m.
    pub median_abs_m: Option<f64>,
    /// Nine in ten of these are below, m; 1 m stands for all that is farther.
    pub p90_abs_m: Option<f64>,
    /// Share of these within 10 cm.
    pub within_10_cm: Option<f64>,
}

impl Agreement {
    /// Adds the shots of a frame: those whose recorded return is on an object, or those whose return is not.
    pub fn add(&mut self, frame: &FrameShots, objects: bool) {
        self.bins.resize(BINS_PER_M as usize + 1, 0);
        for ((shot, shown), on_object) in frame.shots.iter().zip(&frame.shown).zip(&frame.on_object) {
            let object = if shot.measured.is_some() { *on_object } else { shown.is_some_and(|s| s.object) };
            if object != objects {
                continue;
            }
            self.shown += u64::from(shown.is_some());
            let Some(i) = shot.measured else { continue };
            self.measured += 1;
            if let Some(shown) = shown {
                let off = (shown.range_m - frame.scan.returns.range_m[i as usize]).abs();
                self.bins[((off * BINS_PER_M) as usize).min(BINS_PER_M as usize)] += 1;
                self.met += 1;
                self.shown_met += 1;
            }
        }
    }

    /// The sums as shares.
    pub fn numbers(&self) -> AgreementNumbers {
        let share = |a: u64, b: u64| if b == 0 { 0.0 } else { a as f64 / b as f64 };
        let below = |bin: usize| self.bins.iter().take(bin).sum::<u64>();
        let any = self.met > 0;
        let quantile = |tenths: u64| {
            let bin = (0..self.bins.len()).find(|bin| 10 * below(bin + 1) >= tenths * self.met).filter(|_| any)?;
            Some((bin as f64 + 0.5) / f64::from(BINS_PER_M))
        };
        AgreementNumbers {
            measured_returns: self.measured,
            met_share: share(self.met, self.measured),
            twin_returns: self.shown,
            twin_met_share: share(self.shown_met, self.shown),
            median_abs_m: quantile(5),
            p90_abs_m: quantile(9),
            within_10_cm: any.then(|| share(below((0.1 * BINS_PER_M) as usize), self.met)),
        }
    }
}
