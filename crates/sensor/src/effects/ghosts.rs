//! D2: light that takes a way round by a mirror.

use super::{Draws, FrameContext, Need, SensorEffect};
use crate::scan::{Scan, dot};
use data::KeyError;
use data::toml_text::within;
use rand::RngExt;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// With probability `probability * lobe`, lobe the material's share of directed light, the return of a shot is not the surface's own but that of
/// what the surface mirrors: the point then lies behind the surface, at the range `R + L`, L the way from the surface to what is mirrored, m,
/// at most `longest_m`. Where the mirror shows nothing the return stays.
///
/// Typical: rare on paint and metal, frequent at glass fronts and wet roads (Waymo's issue 387; the data set Ghost-FWL).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Ghosts {
    /// 0 to 1, for a surface that mirrors all of the light.
    pub probability: f64,
    /// m.
    pub longest_m: f64,
}

impl Default for Ghosts {
    fn default() -> Self {
        Ghosts { probability: 0.02, longest_m: 60.0 }
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

/// The mirrored ray: from just before the surface, about its normal.
fn reflection(echo: &crate::scan::Echo) -> ([f32; 3], [f32; 3]) {
    let (point, n, d) = (echo.point(), echo.normal, echo.direction);
    let along = dot(n, d);
    let start = std::array::from_fn(|k| point[k] + 0.01 * n[k]);
    (start, std::array::from_fn(|k| d[k] - 2.0 * along * n[k]))
}
