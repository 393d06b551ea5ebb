//! A9: coordinates rounded to a step, as by a file format.

use super::{Draws, FrameContext, Reads, SensorEffect};
use crate::scan::Scan;
use data::KeyError;
use data::toml_text::within;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Each of x, y, z becomes `step_m * round(v / step_m)`, m, in the cloud's frame. Unlike [`super::RangeQuantisation`],
/// it does not quantise ranges.
///
/// Typical: 1 mm (the files of KITTI).
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct CoordinateRounding {
    /// Step, m; 0 for no rounding.
    pub step_m: f64,
}

impl SensorEffect for CoordinateRounding {
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
            let rounded = echo.point().map(|v| ((f64::from(v) / self.step_m).round() * self.step_m) as f32);
            echo.move_point(rounded);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn points_lie_on_a_grid() {
        let before = scene();
        let after = applied(&CoordinateRounding { step_m: 0.1 }, &before);
        for (a, b) in before.echoes.iter().zip(&after.echoes).filter(|(a, _)| a.is_return()) {
            for (v, w) in a.point().into_iter().zip(b.point()) {
                assert!((v - w).abs() <= 0.0501 && (w * 10.0 - (w * 10.0).round()).abs() < 2e-3, "{v} {w}");
            }
        }
    }
}
