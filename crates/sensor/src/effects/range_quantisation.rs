//! A9: ranges rounded to a step.

use super::{Draws, FrameContext, Reads, SensorEffect};
use crate::scan::Scan;
use data::KeyError;
use data::toml_text::within;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A range R becomes `step_m * round(R / step_m)`, m, at least one step.
///
/// Typical: 2 mm (Velodyne HDL-64E), 1.2 cm (Ouster OS1 gen 1), 3 cm (ZVISION ML-30S).
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RangeQuantisation {
    /// Step, m; 0 for no rounding.
    pub step_m: f64,
}

impl SensorEffect for RangeQuantisation {
    fn check(&self) -> Result<(), KeyError> {
        within("step_m", self.step_m, 0.0, 10.0)
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn on_scan(&self, scan: &mut Scan, _frame: &FrameContext, _draws: &Draws) {
        if self.step_m == 0.0 {
            return;
        }
        for echo in scan.returns_mut() {
            let steps = (f64::from(echo.range_m) / self.step_m).round().max(1.0);
            echo.range_m = (steps * self.step_m) as f32;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn ranges_are_multiples_of_the_step() {
        let before = scene();
        let after = applied(&RangeQuantisation { step_m: 0.05 }, &before);
        let off = residuals(&before, &after);
        assert!(off.iter().all(|v| v.abs() <= 0.0251));
        let (mean, std) = moments(&off);
        assert!(mean.abs() < 2e-3 && (std - 0.05 / 12_f64.sqrt()).abs() < 2e-3, "{mean} {std}");
        assert!(after.returns().all(|e| {
            let steps = f64::from(e.range_m) / 0.05;
            (steps - steps.round()).abs() < 1e-3
        }));
    }
}
