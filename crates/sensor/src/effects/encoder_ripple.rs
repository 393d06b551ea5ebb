//! E1: a range error that is periodic in azimuth.

use super::{Draws, FrameContext, Reads, SensorEffect};
use crate::scan::Scan;
use data::KeyError;
use data::toml_text::within;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// `amplitude_m * sin(periods * a + phase_rad)`, m, is added to each range, a the azimuth in the cloud's frame, rad.
/// The effect is not in the usual catalogues; it tests a diagnosis on unknown causes.
///
/// Typical: millimetres to centimetres (0.02 m).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct EncoderRipple {
    /// Amplitude, m.
    pub amplitude_m: f64,
    /// Periods per turn.
    pub periods: f64,
    /// Phase at azimuth 0, rad.
    pub phase_rad: f64,
}

impl Default for EncoderRipple {
    fn default() -> Self {
        EncoderRipple { amplitude_m: 0.0, periods: 6.0, phase_rad: 0.0 }
    }
}

impl SensorEffect for EncoderRipple {
    fn check(&self) -> Result<(), KeyError> {
        within("amplitude_m", self.amplitude_m, -5.0, 5.0)?;
        within("periods", self.periods, 0.0, 1e4)?;
        within("phase_rad", self.phase_rad, -100.0, 100.0)
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn on_scan(&self, scan: &mut Scan, _frame: &FrameContext, _draws: &Draws) {
        for echo in scan.returns_mut() {
            let azimuth = f64::from(echo.direction[1]).atan2(echo.direction[0].into());
            let off = self.amplitude_m * (self.periods * azimuth + self.phase_rad).sin();
            echo.add_range(off as f32);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn a_sine_over_azimuth() {
        let before = scene();
        let after = applied(&EncoderRipple { amplitude_m: 0.05, periods: 12.0, phase_rad: 0.5 }, &before);
        for (a, b) in before.echoes.iter().zip(&after.echoes).filter(|(a, _)| a.is_return()) {
            let azimuth = f64::from(a.direction[1].atan2(a.direction[0]));
            let want = 0.05 * (12.0 * azimuth + 0.5).sin();
            assert!((f64::from(b.range_m - a.range_m) - want).abs() < 2e-5);
        }
    }
}
