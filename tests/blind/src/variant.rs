//! Variants of a case: number of sensors, intensity column, and what the rig file says.

use data::Stream;
use rand::RngExt;
use serde::{Deserialize, Serialize};

/// A variant of a case. The default is that of `draw_case`: a drawn rig, no intensity, a rig file without pattern.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Variant {
    /// Number of sensors, 1 to 4; `None`: drawn.
    pub sensors: Option<usize>,
    /// Fourth column of the clouds, on both sides.
    pub intensity: Intensity,
    /// Whether the rig file states rows and columns.
    pub rig_has_pattern: bool,
}

/// Fourth column of a cloud.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Intensity {
    /// No column: x, y, z only.
    #[default]
    None,
    /// Reflectivity of the surface, 0 to 1.
    Reflectivity,
    /// Whole numbers, 0 to 255, that fall with range and incidence.
    Counts,
    /// Random numbers, 0 to 1.
    Noise,
}

/// What the intensity of a point depends on; all 0 for a false return.
#[derive(Clone, Copy, Debug, Default)]
pub struct Light {
    /// Reflectivity of the surface.
    pub reflectivity: f64,
    /// Cosine of the angle of incidence.
    pub cos_incidence: f64,
    /// True range, m.
    pub range_m: f64,
}

/// Range at which counts have fallen to one half, m.
const HALF_COUNTS_M: f64 = 40.0;

impl Intensity {
    /// All kinds.
    pub const ALL: [Intensity; 4] = [Intensity::None, Intensity::Reflectivity, Intensity::Counts, Intensity::Noise];

    /// Name in tables.
    pub fn name(self) -> &'static str {
        match self {
            Intensity::None => "none",
            Intensity::Reflectivity => "reflectivity",
            Intensity::Counts => "counts",
            Intensity::Noise => "noise",
        }
    }

    /// Values per point.
    pub fn channels(self) -> usize {
        if self == Intensity::None { 3 } else { 4 }
    }

    /// The value of a point, `None` without the column. Reflectivity and counts scatter by up to 8 %.
    pub fn value(self, light: &Light, rng: &mut Stream) -> Option<f32> {
        if self == Intensity::None {
            return None;
        }
        let u: f64 = rng.random();
        let scatter = 1.0 + 0.16 * (u - 0.5);
        Some(match self {
            Intensity::None | Intensity::Noise => u as f32,
            Intensity::Reflectivity => (light.reflectivity * scatter).min(1.0) as f32,
            Intensity::Counts => {
                let fallen = 1.0 / (1.0 + (light.range_m / HALF_COUNTS_M).powi(2));
                let counts = 400.0 * light.reflectivity * light.cos_incidence.sqrt() * fallen * scatter;
                counts.round().clamp(0.0, 255.0) as f32
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_fall_with_range_and_incidence() {
        let mut rng = data::stream(1, "variant", 0, 0);
        let mut counts = |range_m: f64, cos_incidence: f64| {
            Intensity::Counts.value(&Light { reflectivity: 0.5, cos_incidence, range_m }, &mut rng).unwrap()
        };
        let near = counts(5.0, 1.0);
        assert!((150.0..=255.0).contains(&near) && near.fract() == 0.0, "{near}");
        assert!(counts(80.0, 1.0) < 0.5 * near && counts(5.0, 0.1) < 0.5 * near);
        let bright = Intensity::Reflectivity.value(&Light { reflectivity: 0.5, ..Light::default() }, &mut rng).unwrap();
        assert!((0.45..0.55).contains(&bright) && Intensity::None.value(&Light::default(), &mut rng).is_none());
    }
}
