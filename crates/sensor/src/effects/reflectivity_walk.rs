//! A8: range walk, a range error that depends on reflectivity.

use super::{Draws, FrameContext, Need, Reads, SensorEffect};
use crate::cloud_scan::ROUND_COS;
use crate::scan::Scan;
use data::KeyError;
use data::toml_text::within;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// `walk_m * ln(reflectivity / reference)`, m, is added to each range. The edge of a strong pulse crosses the detection
/// threshold earlier, so `walk_m` is negative for a receiver without compensation.
///
/// With `of_intensity` the intensity of a return takes the place of its reflectivity, without the fall that the
/// exponents state: `intensity (R / 20 m)^range_exponent cos^-incidence_exponent`. A diagnosis writes it.
///
/// Typical: -0.5 to -3 cm per factor e of reflectivity; "slight bias for retro-reflectors" in data sheets.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ReflectivityWalk {
    /// Change of range per factor e of reflectivity, m.
    pub walk_m: f64,
    /// Reflectivity at which the error is 0; with `of_intensity` an intensity, in the unit of the cloud.
    pub reference: f64,
    /// Whether the intensity that a cloud has tells brightness, in its own unit.
    pub of_intensity: bool,
    /// Exponent of the fall of this intensity with range.
    pub range_exponent: f64,
    /// Exponent of its fall with the cosine of the angle of incidence.
    pub incidence_exponent: f64,
}

impl Default for ReflectivityWalk {
    fn default() -> Self {
        ReflectivityWalk {
            walk_m: 0.0,
            reference: 0.3,
            of_intensity: false,
            range_exponent: 0.0,
            incidence_exponent: 0.0,
        }
    }
}

impl ReflectivityWalk {
    /// Range at which an intensity has no fall with range, m.
    pub const REFERENCE_M: f64 = 20.0;

    /// Smallest cosine of incidence that the fall of an intensity is followed to.
    pub const LEAST_COS: f64 = 0.02;
}

impl SensorEffect for ReflectivityWalk {
    fn check(&self) -> Result<(), KeyError> {
        within("walk_m", self.walk_m, -1.0, 1.0)?;
        within("reference", self.reference, 1e-9, 1e9)?;
        within("range_exponent", self.range_exponent, -10.0, 10.0)?;
        within("incidence_exponent", self.incidence_exponent, -10.0, 10.0)
    }

    fn needs(&self) -> Option<&'static [Need]> {
        Some(match (self.of_intensity, self.incidence_exponent == 0.0) {
            (false, _) => &[Need::Reflectivity],
            (true, true) => &[],
            (true, false) => &[Need::Incidence],
        })
    }

    fn reads(&self) -> Reads {
        if self.of_intensity && self.incidence_exponent == 0.0 { Reads::NOTHING } else { Reads::SURFACES }
    }

    fn on_scan(&self, scan: &mut Scan, _frame: &FrameContext, _draws: &Draws) {
        for echo in scan.returns_mut() {
            let mut bright = f64::from(echo.reflectivity);
            if self.of_intensity {
                let cos = if echo.cos_incidence > 0.0 { echo.cos_incidence } else { ROUND_COS };
                let range = (f64::from(echo.range_m).max(0.05) / Self::REFERENCE_M).powf(self.range_exponent);
                let facing = f64::from(cos).max(Self::LEAST_COS).powf(self.incidence_exponent);
                bright = f64::from(echo.intensity) * range / facing;
            }
            if bright > 0.0 {
                echo.add_range((self.walk_m * (bright / self.reference).ln()) as f32);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    fn walk(walk_m: f64, reference: f64) -> ReflectivityWalk {
        ReflectivityWalk { walk_m, reference, ..ReflectivityWalk::default() }
    }

    #[test]
    fn bright_surfaces_appear_nearer() {
        for (reflectivity, want) in [(0.2, 0.0), (20.0, -0.0921), (0.02, 0.0461)] {
            let before = plate(5, 30.0, reflectivity);
            let off = residuals(&before, &applied(&walk(-0.02, 0.2), &before));
            assert!((off[0] - want).abs() < 1e-4, "{reflectivity}: {} {want}", off[0]);
        }
    }

    /// Intensities in counts that fall with the square of the range.
    #[test]
    fn an_intensity_tells_brightness_without_its_fall() {
        let effect = ReflectivityWalk { of_intensity: true, range_exponent: 2.0, ..walk(-0.02, 100.0) };
        for (range_m, intensity) in [(10.0, 400.0), (40.0, 25.0), (20.0, 100.0)] {
            let mut before = plate(5, range_m, 0.5);
            before.returns_mut().for_each(|echo| echo.intensity = intensity);
            let off = residuals(&before, &applied(&effect, &before));
            assert!(off[0].abs() < 1e-4, "{range_m}: {}", off[0]);
            before.returns_mut().for_each(|echo| echo.intensity *= std::f32::consts::E);
            let off = residuals(&before, &applied(&effect, &before));
            assert!((off[0] + 0.02).abs() < 1e-4, "{range_m}: {}", off[0]);
        }
    }
}
