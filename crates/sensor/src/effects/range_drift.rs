//! A10: a range offset that changes with time, as by warm-up.

use super::{Draws, FrameContext, Reads, SensorEffect};
use crate::scan::Scan;
use data::KeyError;
use data::toml_text::within;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// `drift_m * (1 - exp(-t / time_constant_s))`, m, is added to each range, t the time since the start of the data set,
/// s.
///
/// Typical: a few millimetres to centimetres (0.02 m) within half an hour (Glennie and Lichti 2011 on the HDL-64E).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RangeDrift {
    /// Final offset, m.
    pub drift_m: f64,
    /// Time after which 63 % of the final offset are reached, s.
    pub time_constant_s: f64,
}

impl Default for RangeDrift {
    fn default() -> Self {
        RangeDrift { drift_m: 0.0, time_constant_s: 600.0 }
    }
}

impl SensorEffect for RangeDrift {
    fn check(&self) -> Result<(), KeyError> {
        within("drift_m", self.drift_m, -10.0, 10.0)?;
        within("time_constant_s", self.time_constant_s, 0.01, 1e6)
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn on_scan(&self, scan: &mut Scan, frame: &FrameContext, _draws: &Draws) {
        let drift = (self.drift_m * (1.0 - (-frame.time_s / self.time_constant_s).exp())) as f32;
        for echo in scan.returns_mut() {
            echo.add_range(drift);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn the_offset_grows_from_0_to_the_final_value() {
        let (before, effect) = (plate(5, 30.0, 0.5), RangeDrift { drift_m: 0.05, time_constant_s: 10.0 });
        for (frame, want) in [(0, 0.0), (200, 0.05 * (1.0 - (-1.0_f64).exp())), (20_000, 0.05)] {
            let off = residuals(&before, &applied_in(frame, &effect, &before));
            assert!((off[0] - want).abs() < 1e-5, "{frame}: {} {want}", off[0]);
        }
    }
}
