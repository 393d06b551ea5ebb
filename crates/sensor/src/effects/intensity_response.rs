//! D8: another dependence of the intensity on range, incidence and brightness than the simulation's.

use super::{Draws, FrameContext, Need, Reads, SensorEffect};
use crate::cloud_scan::ROUND_COS;
use crate::scan::Scan;
use data::KeyError;
use data::toml_text::within;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The intensity I becomes `gain * I^gamma * (reference_m / R)^range_exponent * cos^incidence_exponent`, R the range,
/// m, cos the cosine of the angle of incidence; at most `most`, rounded to a multiple of `step`.
///
/// Unlike `intensity_law`, this effect changes the intensities that are there, in their own unit. It needs no
/// reflectivity. A diagnosis writes it.
///
/// Typical: `gain = 255` from intensities of 0 to 1 to counts of a byte; `range_exponent` 0.2 for a sensor that does
/// not quite correct for range, 2 for raw power; `gamma` 0.5 for a receiver with a square-root response.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct IntensityResponse {
    /// Factor.
    pub gain: f64,
    /// Exponent of the intensity.
    pub gamma: f64,
    /// Range at which the range changes nothing, m.
    pub reference_m: f64,
    /// Exponent of the decrease with range.
    pub range_exponent: f64,
    /// Exponent of the cosine of the angle of incidence.
    pub incidence_exponent: f64,
    /// Largest intensity; no limit if 0.
    pub most: f64,
    /// Step to which intensities are rounded; none if 0.
    pub step: f64,
}

impl Default for IntensityResponse {
    fn default() -> Self {
        IntensityResponse {
            gain: 1.0,
            gamma: 1.0,
            reference_m: 20.0,
            range_exponent: 0.0,
            incidence_exponent: 0.0,
            most: 0.0,
            step: 0.0,
        }
    }
}

impl IntensityResponse {
    /// Whether it leaves every intensity as it is.
    fn is_neutral(&self) -> bool {
        *self == IntensityResponse { reference_m: self.reference_m, ..IntensityResponse::default() }
    }
}

impl SensorEffect for IntensityResponse {
    fn check(&self) -> Result<(), KeyError> {
        within("gain", self.gain, 0.0, 1e9)?;
        within("gamma", self.gamma, 0.0, 10.0)?;
        within("reference_m", self.reference_m, 0.1, 1000.0)?;
        within("range_exponent", self.range_exponent, -10.0, 10.0)?;
        within("incidence_exponent", self.incidence_exponent, -10.0, 10.0)?;
        within("most", self.most, 0.0, 1e9)?;
        within("step", self.step, 0.0, 1e9)
    }

    fn needs(&self) -> Option<&'static [Need]> {
        Some(if self.incidence_exponent == 0.0 { &[] } else { &[Need::Incidence] })
    }

    fn reads(&self) -> Reads {
        if self.incidence_exponent == 0.0 { Reads::NOTHING } else { Reads::SURFACES }
    }

    fn on_scan(&self, scan: &mut Scan, _frame: &FrameContext, _draws: &Draws) {
        if self.is_neutral() {
            return;
        }
        for echo in scan.returns_mut() {
            let cos = if echo.cos_incidence > 0.0 { echo.cos_incidence } else { ROUND_COS };
            let range = (self.reference_m / f64::from(echo.range_m).max(0.05)).powf(self.range_exponent);
            let light = f64::from(echo.intensity).max(0.0).powf(self.gamma) * self.gain;
            let mut intensity = light * range * f64::from(cos).powf(self.incidence_exponent);
            if self.most > 0.0 {
                intensity = intensity.min(self.most);
            }
            if self.step > 0.0 {
                intensity = (intensity / self.step).round() * self.step;
            }
            echo.intensity = intensity as f32;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn the_intensity_follows_the_formula() {
        let law = IntensityResponse { gain: 2.0, gamma: 0.5, range_exponent: 1.0, ..IntensityResponse::default() };
        let limited = IntensityResponse { most: 0.9, ..law.clone() };
        let rounded = IntensityResponse { step: 0.25, ..law.clone() };
        let inclined = IntensityResponse { incidence_exponent: 2.0, ..law.clone() };
        for (effect, range_m, want) in [
            (&law, 20.0, 1.0),
            (&law, 40.0, 0.5),
            (&limited, 20.0, 0.9),
            (&rounded, 50.0, 0.5),
            (&inclined, 20.0, 0.25),
        ] {
            let mut before = plate(1, range_m, 0.25);
            (before.echoes[0].intensity, before.echoes[0].cos_incidence) = (0.25, 0.5);
            let after = applied(effect, &before).echoes[0].intensity;
            assert!((f64::from(after) - want).abs() < 1e-6, "{effect:?} at {range_m} m: {after}");
        }
    }
}
