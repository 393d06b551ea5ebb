//! D3: blooming, a halo of false returns around a bright target.

use super::shot_grid::{ShotGrid, reach};
use super::{Draws, FrameContext, Need, SensorEffect};
use crate::scan::{Scan, dot};
use data::KeyError;
use data::toml_text::within;
use rand::RngExt;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A shot at angle psi from a bright return reports the range of the bright return with probability
/// `strength * exp(-psi / halo_deg)`. A return is bright if its returned light exceeds `returned_above`. Only shots
/// that are not bright themselves and have no return, or a farther one, are affected.
///
/// Typical: a halo of 0.1 to 1 degree around retro-reflectors, strength 0.5.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Blooming {
    /// Returned light above which a target is bright, relative to a white Lambertian plate at normal incidence (1).
    pub returned_above: f64,
    /// Angle at which the probability has fallen to 1/e, degrees.
    pub halo_deg: f64,
    /// Probability at angle 0, 0 to 1.
    pub strength: f64,
}

impl Default for Blooming {
    fn default() -> Self {
        Blooming { returned_above: 2.0, halo_deg: 0.3, strength: 0.0 }
    }
}

impl SensorEffect for Blooming {
    fn check(&self) -> Result<(), KeyError> {
        within("returned_above", self.returned_above, 0.0, 1e4)?;
        within("halo_deg", self.halo_deg, 1e-3, 5.0)?;
        within("strength", self.strength, 0.0, 1.0)
    }

    fn needs(&self) -> Option<&'static [Need]> {
        None
    }

    fn on_scan(&self, scan: &mut Scan, _frame: &FrameContext, draws: &Draws) {
        let grid = ShotGrid::new(scan);
        let (limit, halo) = (self.returned_above as f32, self.halo_deg.to_radians() as f32);
        let mut random = draws.of_frame();
        let mut shown: Vec<(usize, usize)> = Vec::new();
        for (i, bright) in scan.echoes.iter().enumerate().filter(|(_, e)| e.is_return() && e.returned > limit) {
            let (rows, columns) = reach(scan, &grid, bright, 4.0 * halo, 200);
            for k in grid.around(bright, rows, columns) {
                let other = &scan.echoes[k];
                let psi = dot(other.direction, bright.direction).clamp(-1.0, 1.0).acos();
                let chance = self.strength as f32 * (-psi / halo).exp();
                let dark = other.returned <= limit || !other.is_return();
                if dark && other.range_m > bright.range_m && random.random_range(0.0..1.0_f32) < chance {
                    shown.push((k, i));
                }
            }
        }
        for (k, i) in shown {
            let bright = scan.echoes[i];
            let echo = &mut scan.echoes[k];
            if echo.range_m > bright.range_m {
                let halo = 0.1 * bright.returned;
                *echo = crate::scan::Echo {
                    range_m: bright.range_m,
                    normal: bright.normal,
                    returned: halo,
                    object: bright.object,
                    material: bright.material,
                    ..*echo
                };
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn the_bright_board_gets_a_halo_at_its_range() {
        let mut before = scene();
        // Behind the board there is nothing.
        for echo in before.echoes.iter_mut().filter(|e| e.object == 4 && e.reflectivity < 5.0) {
            echo.lose();
        }
        let effect = Blooming { returned_above: 5.0, halo_deg: 0.5, strength: 1.0 };
        let after = applied(&effect, &before);
        let new: Vec<_> = before
            .echoes
            .iter()
            .zip(&after.echoes)
            .filter(|(a, b)| !a.is_return() && b.is_return())
            .map(|(_, b)| b)
            .collect();
        assert!(new.len() > 20, "{}", new.len());
        assert!(new.iter().all(|e| (39.9..41.2).contains(&e.range_m)));
        let angle = |e: &crate::scan::Echo| {
            let [x, y, z] = e.direction;
            (y.atan2(x).to_degrees().abs() - 1.43).max(0.0).hypot((z.asin().to_degrees().abs() - 1.43).max(0.0))
        };
        assert!(new.iter().all(|e| angle(e) < 3.0));
        let near = new.iter().filter(|e| angle(e) < 0.8).count();
        assert!(near * 2 > new.len(), "most are close to it");
        assert_eq!(applied(&Blooming { strength: 0.0, ..effect }, &before), before);
    }
}
