//! A5: outliers in range.

use super::{Draws, FrameContext, Reads, SensorEffect};
use crate::scan::Scan;
use data::KeyError;
use data::toml_text::within;
use rand::RngExt;
use rand_distr::{Distribution, StandardNormal};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// With probability `probability`, `std_m * N(0, 1)`, m, is added to a range, in addition to other noise.
///
/// Typical: 0.1 to 3 % of the returns, 5 to 30 cm.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct HeavyTails {
    /// Fraction of the returns that are outliers, 0 to 1.
    pub probability: f64,
    /// Standard deviation of the outliers' additional error, m.
    pub std_m: f64,
}

impl SensorEffect for HeavyTails {
    fn check(&self) -> Result<(), KeyError> {
        within("probability", self.probability, 0.0, 1.0)?;
        within("std_m", self.std_m, 0.0, 10.0)
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn on_scan(&self, scan: &mut Scan, _frame: &FrameContext, draws: &Draws) {
        let mut random = draws.of_frame();
        for echo in scan.returns_mut() {
            if random.random_bool(self.probability) {
                let noise: f32 = StandardNormal.sample(&mut random);
                echo.add_range(self.std_m as f32 * noise);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn the_fraction_of_outliers_is_the_probability() {
        let before = plate(40_000, 30.0, 0.5);
        let off = residuals(&before, &applied(&HeavyTails { probability: 0.02, std_m: 0.2 }, &before));
        let touched: Vec<f64> = off.iter().copied().filter(|v| *v != 0.0).collect();
        let share = touched.len() as f64 / off.len() as f64;
        let (mean, std) = moments(&touched);
        assert!((share - 0.02).abs() < 0.003 && mean.abs() < 0.03 && (std - 0.2).abs() < 0.02, "{share} {mean} {std}");
        let (_, all) = moments(&off);
        let kurtosis = off.iter().map(|v| v.powi(4)).sum::<f64>() / off.len() as f64 / all.powi(4);
        assert!(kurtosis > 50.0, "{kurtosis}");
    }
}
