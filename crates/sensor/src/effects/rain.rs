//! D4: rain: attenuation and returns from drops near the sensor.

use super::{Draws, FrameContext, Need, SensorEffect};
use crate::scan::Scan;
use data::KeyError;
use data::toml_text::within;
use rand::RngExt;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// At a rain rate of q mm/h, the light of a return at range R is multiplied by `exp(-2 alpha R)` with
/// `alpha = 1e-3 * 0.2 * q^0.6`, 1/m. With probability `drops * q / 10`, a shot reports a drop at range
/// `0.3 m - 2 m * ln(U)`, U uniform between 0 and 1, if that is nearer than its surface. Only near drops return enough
/// light.
///
/// Typical: 2 (light) to 50 mm/h (violent); 0.1 to 1 % of the shots at 10 mm/h (drops 0.003).
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Rain {
    /// Rain rate, mm/h.
    pub rate_mm_per_h: f64,
    /// Probability that a shot reports a drop at 10 mm/h, 0 to 1.
    pub drops: f64,
}

/// Mean distance of reported drops beyond 0.3 m, m.
const DROP_RANGE_M: f32 = 2.0;

impl SensorEffect for Rain {
    fn check(&self) -> Result<(), KeyError> {
        within("rate_mm_per_h", self.rate_mm_per_h, 0.0, 300.0)?;
        within("drops", self.drops, 0.0, 1.0)
    }

    fn needs(&self) -> Option<&'static [Need]> {
        Some(&[Need::Reflectivity])
    }

    fn on_scan(&self, scan: &mut Scan, _frame: &FrameContext, draws: &Draws) {
        let alpha = (2e-4 * self.rate_mm_per_h.powf(0.6)) as f32;
        let chance = (self.drops * self.rate_mm_per_h / 10.0).min(1.0);
        let mut random = draws.of_frame();
        for echo in &mut scan.echoes {
            if echo.is_return() {
                echo.returned *= (-2.0 * alpha * echo.range_m).exp();
            }
            let (hit, part) = (random.random_bool(chance), random.random_range(0.0..1.0_f32));
            let range_m = 0.3 - DROP_RANGE_M * (1.0 - part).ln();
            if hit && range_m < echo.range_m {
                echo.range_m = range_m;
                (echo.returned, echo.reflectivity, echo.object) = (0.02, 0.02, 0);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn drops_are_few_and_near() {
        let before = plate(40_000, 80.0, 0.5);
        let after = applied(&Rain { rate_mm_per_h: 20.0, drops: 0.02 }, &before);
        let drops: Vec<f64> = after.echoes.iter().filter(|e| e.range_m != 80.0).map(|e| e.range_m.into()).collect();
        let share = drops.len() as f64 / 40_000.0;
        let (mean, _) = moments(&drops);
        assert!((share - 0.04).abs() < 0.004 && (mean - 2.3).abs() < 0.2, "{share} {mean}");
        let kept = after.echoes.iter().find(|e| e.range_m == 80.0).unwrap();
        let alpha = 2e-4 * 20_f64.powf(0.6);
        assert!((f64::from(kept.returned) / 0.5 / (-160.0 * alpha).exp() - 1.0).abs() < 1e-3);
    }
}
