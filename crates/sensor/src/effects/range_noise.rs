//! A1: range noise with a constant standard deviation.

use super::{Draws, FrameContext, Reads, SensorEffect};
use crate::scan::Scan;
use data::KeyError;
use data::toml_text::within;
use rand_distr::{Distribution, StandardNormal};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// `std_m * N(0, 1)`, m, is added to each range.
///
/// Typical: 0.02 (default of the simulator of Huch et al. 2023 and their "sim noise"), 0.01 to 0.03 in data sheets.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RangeNoise {
    /// Standard deviation, m.
    pub std_m: f64,
}

impl SensorEffect for RangeNoise {
    fn check(&self) -> Result<(), KeyError> {
        within("std_m", self.std_m, 0.0, 10.0)
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn on_scan(&self, scan: &mut Scan, _frame: &FrameContext, draws: &Draws) {
        add_noise(scan, draws, |_| self.std_m as f32);
    }
}

/// Adds Gaussian noise to each range; `std_m` is its standard deviation as a function of the echo. Ranges stay at least
/// 1 cm.
pub(super) fn add_noise(scan: &mut Scan, draws: &Draws, std_m: impl Fn(&crate::scan::Echo) -> f32) {
    let mut random = draws.of_frame();
    for echo in scan.returns_mut() {
        let noise: f32 = StandardNormal.sample(&mut random);
        echo.add_range(std_m(echo) * noise);
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn the_deviation_is_the_same_at_every_range() {
        for range_m in [5.0, 50.0, 200.0] {
            let before = plate(20_000, range_m, 0.5);
            let (mean, std) = moments(&residuals(&before, &applied(&RangeNoise { std_m: 0.03 }, &before)));
            assert!(mean.abs() < 1e-3 && (std - 0.03).abs() < 1e-3, "{range_m}: {mean} {std}");
        }
    }

    #[test]
    fn frames_differ_and_repeat() {
        let (before, effect) = (plate(100, 20.0, 0.5), RangeNoise { std_m: 0.02 });
        assert_eq!(applied_in(3, &effect, &before), applied_in(3, &effect, &before));
        assert_ne!(applied_in(3, &effect, &before), applied_in(4, &effect, &before));
    }
}
