//! D1: beam divergence, which gives mixed ranges at edges.

use super::shot_grid::ShotGrid;
use super::{Draws, FrameContext, Need, SensorEffect};
use crate::beams::{BeamWidth, Beams, Pick};
use crate::scan::{Echo, Scan, dot};
use data::KeyError;
use data::toml_text::{within, wrong};
use rand::RngExt;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A shot is a bundle of 7 or 19 rays within `divergence_rad`, weighted as a Gaussian beam. Surfaces less than
/// `pulse_m` apart along the beam give one return at the mean of their ranges, weighted by returned light. If a shot
/// has several returns, `pick` selects the one that is reported.
///
/// Typical: 0.7 to 3 mrad; a pulse of 4 ns is 0.6 m long.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct BeamDivergence {
    /// Full divergence angle, rad; 0 for a single ray.
    pub divergence_rad: f64,
    /// Number of rays per shot: 7 or 19.
    pub rays: u32,
    /// Range separation below which surfaces give one return, m (about the pulse length).
    pub pulse_m: f64,
    /// Which of several returns is reported.
    pub pick: Pick,
}

impl Default for BeamDivergence {
    fn default() -> Self {
        BeamDivergence { divergence_rad: 0.0, rays: 7, pulse_m: 0.6, pick: Pick::Strongest }
    }
}

impl SensorEffect for BeamDivergence {
    fn check(&self) -> Result<(), KeyError> {
        within("divergence_rad", self.divergence_rad, 0.0, 0.1)?;
        within("pulse_m", self.pulse_m, 0.0, 100.0)?;
        if [7, 19].contains(&self.rays) {
            Ok(())
        } else {
            Err(wrong("rays", format!("{} is neither 7 nor 19", self.rays)))
        }
    }

    fn needs(&self) -> Option<&'static [Need]> {
        Some(&[Need::Grid, Need::Incidence])
    }

    /// On a finished cloud the edge between two neighbouring shots lies at a random place between them. A shot that
    /// covers it reports the mean of both ranges, weighted by the area of the beam on either side.
    fn on_cloud(&self, scan: &mut Scan, _frame: &FrameContext, draws: &Draws) {
        if self.divergence_rad == 0.0 {
            return;
        }
        let grid = ShotGrid::new(scan);
        let half = 0.5 * self.divergence_rad as f32;
        let mut random = draws.of_frame();
        let mut mixed = Vec::new();
        for (i, echo) in scan.echoes.iter().enumerate().filter(|(_, e)| e.is_return()) {
            for k in grid.around(echo, 1, 1).filter(|k| *k != i) {
                let other = &scan.echoes[k];
                let apart = dot(echo.direction, other.direction).clamp(-1.0, 1.0).acos().max(1e-5);
                let beside = echo.row == other.row || echo.column == other.column;
                let gap_m = (echo.range_m - other.range_m).abs();
                if !beside || !other.is_return() || gap_m >= self.pulse_m as f32 || on_one_surface(echo, other) {
                    continue;
                }
                let edge = random.random_range(0.0..1.0_f32) * apart;
                if edge < half {
                    // Area of a unit disc beyond an edge at a distance from its middle, as a share.
                    let d = edge / half;
                    let beyond = 0.5 - (d * (1.0 - d * d).max(0.0).sqrt() + d.asin()) / std::f32::consts::PI;
                    mixed.push((i, (1.0 - beyond) * echo.range_m + beyond * other.range_m));
                    break;
                }
            }
        }
        for (i, range_m) in mixed {
            scan.echoes[i].range_m = range_m;
        }
    }

    fn on_beams(&self, beams: &mut Beams, _frame: &FrameContext, _draws: &Draws) {
        if self.divergence_rad == 0.0 {
            return;
        }
        beams.width = Some(BeamWidth {
            divergence_rad: self.divergence_rad as f32,
            rays: self.rays as usize,
            pulse_m: self.pulse_m as f32,
            pick: self.pick,
            second: false,
        });
    }
}

/// Distance across a surface within which another return lies on it, m.
const ON_SURFACE_M: f32 = 0.15;

/// Whether two returns lie on one surface.
fn on_one_surface(a: &Echo, b: &Echo) -> bool {
    let (p, q) = (a.point(), b.point());
    let between: [f32; 3] = std::array::from_fn(|k| q[k] - p[k]);
    [a, b].into_iter().any(|e| e.normal != [0.0; 3] && dot(e.normal, between).abs() < ON_SURFACE_M)
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    // Mixed ranges at a post in front of a wall are tested with the scene.
    #[test]
    fn beams_get_their_width() {
        let mut beams = Beams::of(&rig());
        let effect = BeamDivergence { divergence_rad: 0.002, ..BeamDivergence::default() };
        with_frame(0, |frame, draws| effect.on_beams(&mut beams, frame, draws));
        let width = beams.width.unwrap();
        assert_eq!((width.rays, width.second, width.pick), (7, false, Pick::Strongest));
        assert!((width.divergence_rad - 0.002).abs() < 1e-9);
        assert!(BeamDivergence { rays: 8, ..BeamDivergence::default() }.check().is_err());
    }
}
