//! B2: returns lost where too little light comes back: the lidar equation.

use super::random_dropout::drop_some;
use super::{Draws, FrameContext, Need, SensorEffect};
use crate::scan::Scan;
use data::KeyError;
use data::toml_text::within;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A return is detected with probability `most / (1 + exp(-steepness * (u - threshold)))`, u the echo's signal index
/// `ln(returned / R^2) - ln(0.1 / 250^2)` less `2 * attenuation_per_m * R`.
///
/// Typical: threshold 0 is the reach of the data sheet (250 m at 10 %); -2 to 3; steepness 2 to 8.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SignalDropout {
    /// Probability of detection where there is light enough, 0 to 1.
    pub most: f64,
    /// Signal index at which half of that is detected.
    pub threshold: f64,
    /// How sharp the threshold is.
    pub steepness: f64,
    /// What the air takes of the light, one way, 1/m.
    pub attenuation_per_m: f64,
}

impl Default for SignalDropout {
    fn default() -> Self {
        SignalDropout { most: 1.0, threshold: 0.0, steepness: 3.0, attenuation_per_m: 0.0 }
    }
}

impl SensorEffect for SignalDropout {
    fn check(&self) -> Result<(), KeyError> {
        within("most", self.most, 0.0, 1.0)?;
        within("threshold", self.threshold, -20.0, 20.0)?;
        within("steepness", self.steepness, 0.01, 100.0)?;
        within("attenuation_per_m", self.attenuation_per_m, 0.0, 1.0)
    }

    fn needs(&self) -> Option<&'static [Need]> {
        Some(&[Need::Incidence, Need::Reflectivity])
    }

    fn on_scan(&self, scan: &mut Scan, _frame: &FrameContext, draws: &Draws) {
        let [most, threshold, steepness, attenuation] =
            [self.most, self.threshold, self.steepness, self.attenuation_per_m].map(|v| v as f32);
        drop_some(scan, draws, |echo| {
            let signal = echo.signal() - 2.0 * attenuation * echo.range_m;
            1.0 - most / (1.0 + (-steepness * (signal - threshold)).exp())
        });
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn half_is_lost_at_the_reach_whatever_makes_the_light_weak() {
        let effect = SignalDropout { most: 0.9, threshold: 0.0, steepness: 4.0, attenuation_per_m: 0.0 };
        let logistic = |u: f64| 1.0 - 0.9 / (1.0 + (-4.0 * u).exp());
        // Twice the range is a quarter of the light.
        for (range_m, reflectivity, u) in [
            (250.0, 0.1, 0.0),
            (125.0, 0.025, 0.0),
            (250.0, 0.15, 1.5_f64.ln()),
            (500.0, 0.1, -4.0_f64.ln()),
            (50.0, 0.1, 25_f64.ln()),
        ] {
            let before = plate(20_000, range_m, reflectivity);
            let got = lost(&before, &applied(&effect, &before));
            assert!((got - logistic(u)).abs() < 0.015, "{range_m} {reflectivity}: {got} {}", logistic(u));
        }
        let hazy = SignalDropout { attenuation_per_m: 0.01, ..effect };
        let before = plate(20_000, 250.0, 0.1);
        assert!((lost(&before, &applied(&hazy, &before)) - logistic(-5.0)).abs() < 0.01);
    }
}
