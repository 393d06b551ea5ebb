//! B10: returns lost next to a bright target.

use super::shot_grid::{ShotGrid, reach};
use super::{Draws, FrameContext, Need, SensorEffect};
use crate::scan::{Scan, dot};
use data::KeyError;
use data::toml_text::within;
use rand::RngExt;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A return within `radius_deg` of a bright return is lost with probability `share`. A return is bright if its returned
/// light exceeds `returned_above`. Bright returns are not lost. Sensors that filter blooming artefacts also remove
/// valid returns.
///
/// Typical: 0.2 to 1 degree around signs and number plates, share 0.5.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct BrightTargetDropout {
    /// Returned light above which a target is bright, relative to a white Lambertian plate at normal incidence (1).
    pub returned_above: f64,
    /// Radius of the affected region around a bright return, degrees.
    pub radius_deg: f64,
    /// Probability that an affected return is lost, 0 to 1.
    pub share: f64,
}

impl Default for BrightTargetDropout {
    fn default() -> Self {
        BrightTargetDropout { returned_above: 2.0, radius_deg: 0.6, share: 0.0 }
    }
}

impl SensorEffect for BrightTargetDropout {
    fn check(&self) -> Result<(), KeyError> {
        within("returned_above", self.returned_above, 0.0, 1e4)?;
        within("radius_deg", self.radius_deg, 0.0, 10.0)?;
        within("share", self.share, 0.0, 1.0)
    }

    fn needs(&self) -> Option<&'static [Need]> {
        Some(&[Need::Reflectivity, Need::Grid])
    }

    fn on_scan(&self, scan: &mut Scan, _frame: &FrameContext, draws: &Draws) {
        let grid = ShotGrid::new(scan);
        let limit = self.returned_above as f32;
        let (radius, nearest) = (self.radius_deg.to_radians() as f32, self.radius_deg.to_radians().cos() as f32);
        let mut blinded = vec![false; scan.echoes.len()];
        for bright in scan.returns().filter(|e| e.returned > limit) {
            let (rows, columns) = reach(scan, &grid, bright, radius, 200);
            for i in grid.around(bright, rows, columns) {
                let other = &scan.echoes[i];
                blinded[i] |= other.returned <= limit && dot(other.direction, bright.direction) >= nearest;
            }
        }
        let mut random = draws.of_frame();
        for (echo, blinded) in scan.echoes.iter_mut().zip(blinded) {
            if echo.is_return() && blinded && random.random_range(0.0..1.0_f32) < self.share as f32 {
                echo.lose();
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn only_neighbours_of_the_bright_board_are_lost() {
        let before = scene();
        let effect = BrightTargetDropout { returned_above: 5.0, radius_deg: 3.0, share: 1.0 };
        let after = applied(&effect, &before);
        // The board is +-1 m at 40 m: +-1.43 degrees.
        for (a, b) in before.echoes.iter().zip(&after.echoes).filter(|(a, _)| a.is_return()) {
            let [x, y, z] = a.direction;
            let (az, el) = (y.atan2(x).to_degrees().abs(), z.asin().to_degrees().abs());
            let bright = a.reflectivity > 5.0;
            let beside = (az - 1.43).max(0.0).hypot((el - 1.43).max(0.0));
            if bright || beside > 3.9 {
                assert!(b.is_return(), "{az} {el}");
            } else if beside < 1.8 {
                assert!(!b.is_return(), "{az} {el}");
            }
        }
        let half = lost(&before, &applied(&BrightTargetDropout { share: 0.5, ..effect.clone() }, &before));
        let whole = lost(&before, &after);
        assert!((half / whole - 0.5).abs() < 0.1, "{half} {whole}");
    }
}
