//! D7: intensity as a function of returned light and range.

use super::{Draws, FrameContext, Need, Reads, SensorEffect};
use crate::scan::Scan;
use data::KeyError;
use data::toml_text::within;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The intensity becomes `min(gain * (returned * (reference_m / R)^range_exponent)^gamma, 1)`, R the range, m, rounded
/// to a multiple of `1 / levels`.
///
/// Typical: gain 1; range_exponent 2 for raw power, 0 for sensors that correct for range; 100 levels (KITTI) or 255;
/// saturation on retro-reflectors.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct IntensityLaw {
    /// Intensity of a white Lambertian plate at normal incidence and range `reference_m`, before saturation.
    pub gain: f64,
    /// Reference range, m.
    #[serde(default = "usual_reference_m")]
    pub reference_m: f64,
    /// Exponent of the decrease with range: 0 for intensities corrected for range, 2 for raw power.
    #[serde(default)]
    pub range_exponent: f64,
    /// Exponent of the receiver's response; 1 is linear.
    #[serde(default = "linear")]
    pub gamma: f64,
    /// Number of steps between 0 and 1.
    #[serde(default = "levels_of_a_byte")]
    pub levels: u32,
}

fn usual_reference_m() -> f64 {
    20.0
}

fn linear() -> f64 {
    1.0
}

fn levels_of_a_byte() -> u32 {
    255
}

impl SensorEffect for IntensityLaw {
    fn check(&self) -> Result<(), KeyError> {
        within("gain", self.gain, 0.0, 1e6)?;
        within("reference_m", self.reference_m, 0.1, 1000.0)?;
        within("range_exponent", self.range_exponent, 0.0, 4.0)?;
        within("gamma", self.gamma, 0.01, 10.0)?;
        within("levels", self.levels.into(), 1.0, 1e6)
    }

    fn needs(&self) -> Option<&'static [Need]> {
        Some(&[Need::Incidence, Need::Reflectivity])
    }

    fn reads(&self) -> Reads {
        Reads::SURFACES
    }

    fn on_scan(&self, scan: &mut Scan, _frame: &FrameContext, _draws: &Draws) {
        let levels = f64::from(self.levels);
        for echo in scan.returns_mut() {
            let range = (self.reference_m / f64::from(echo.range_m)).powf(self.range_exponent);
            let light = (f64::from(echo.returned).max(0.0) * range).powf(self.gamma) * self.gain;
            echo.intensity = ((light.min(1.0) * levels).round() / levels) as f32;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn intensity_follows_the_formula_and_saturates() {
        let effect = IntensityLaw { gain: 0.8, reference_m: 20.0, range_exponent: 2.0, gamma: 0.5, levels: 100 };
        for (range_m, reflectivity, want) in
            [(20.0, 0.25, 0.4), (40.0, 0.25, 0.2), (20.0, 0.0625, 0.2), (5.0, 0.5, 1.0), (100.0, 0.01, 0.02)]
        {
            let after = applied(&effect, &plate(1, range_m, reflectivity));
            assert!(
                (f64::from(after.echoes[0].intensity) - want).abs() < 1e-6,
                "{range_m} {reflectivity}: {}",
                after.echoes[0].intensity
            );
        }
    }
}
