//! D2: ghost returns by specular reflection.

use super::{Draws, FrameContext, Need, SensorEffect};
use crate::scan::{Scan, dot};
use data::KeyError;
use data::toml_text::within;
use rand::RngExt;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// With probability `probability * lobe`, lobe the specular fraction of the material, a shot reports the surface seen
/// by specular reflection instead of the reflecting one. The point then is in the shot's direction at range `R + L`, R
/// the range of the reflecting surface, L the distance from there to the reflected surface, m. If the reflected ray
/// meets nothing within `longest_m`, the return stays as it is.
///
/// Typical: probability 0.02; rare on paint and metal, frequent at glass fronts and wet roads (issue 387 of the Waymo
/// Open Dataset; the data set Ghost-FWL).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Ghosts {
    /// Probability for a fully specular surface (lobe 1), 0 to 1.
    pub probability: f64,
    /// Maximum L, m.
    pub longest_m: f64,
}

impl Default for Ghosts {
    fn default() -> Self {
        Ghosts { probability: 0.0, longest_m: 60.0 }
    }
}

impl SensorEffect for Ghosts {
    fn check(&self) -> Result<(), KeyError> {
        within("probability", self.probability, 0.0, 1.0)?;
        within("longest_m", self.longest_m, 0.0, 1000.0)
    }

    fn needs(&self) -> Option<&'static [Need]> {
        None
    }

    fn on_scan(&self, scan: &mut Scan, frame: &FrameContext, draws: &Draws) {
        let Some(scene) = frame.scene else { return };
        let mut random = draws.of_frame();
        let mut mirrored = Vec::new();
        for (i, echo) in scan.echoes.iter().enumerate().filter(|(_, e)| e.is_return()) {
            let lobe = frame.materials.get(echo.material).lobe;
            if random.random_range(0.0..1.0) < self.probability * lobe {
                mirrored.push(i);
            }
        }
        let rays: Vec<([f32; 3], [f32; 3])> = mirrored.iter().map(|i| reflection(&scan.echoes[*i])).collect();
        for (i, surface) in mirrored.iter().zip(scene.cast(&rays)) {
            let echo = &mut scan.echoes[*i];
            if surface.range_m <= self.longest_m as f32 {
                echo.range_m += surface.range_m;
                echo.object = surface.object;
                echo.returned *= frame.materials.get(surface.material).returned(surface.cos_incidence.into()) as f32;
            }
        }
    }
}

/// The reflected ray: it starts 1 cm in front of the surface and is mirrored about its normal.
fn reflection(echo: &crate::scan::Echo) -> ([f32; 3], [f32; 3]) {
    let (point, n, d) = (echo.point(), echo.normal, echo.direction);
    let along = dot(n, d);
    let start = std::array::from_fn(|k| point[k] + 0.01 * n[k]);
    (start, std::array::from_fn(|k| d[k] - 2.0 * along * n[k]))
}
