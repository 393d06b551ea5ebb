//! B1: returns lost at random.

use super::{Draws, FrameContext, Reads, SensorEffect};
use crate::scan::{Echo, Scan};
use data::KeyError;
use data::toml_text::within;
use rand::RngExt;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A return is lost with probability `share`.
///
/// Typical: 0.20 in the "sim downsampled" of Huch et al. 2023; 0.45 is the default of CARLA; recorded road data lose
/// 0.05 to 0.15 on average.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RandomDropout {
    /// Probability of a loss, 0 to 1.
    pub share: f64,
}

impl SensorEffect for RandomDropout {
    fn check(&self) -> Result<(), KeyError> {
        within("share", self.share, 0.0, 1.0)
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn on_scan(&self, scan: &mut Scan, _frame: &FrameContext, draws: &Draws) {
        drop_some(scan, draws, |_| self.share as f32);
    }
}

/// Removes each return with the probability `share` of its echo.
pub(super) fn drop_some(scan: &mut Scan, draws: &Draws, share: impl Fn(&Echo) -> f32) {
    let mut random = draws.of_frame();
    for echo in scan.returns_mut() {
        if random.random_range(0.0..1.0_f32) < share(echo) {
            echo.lose();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn the_fraction_lost_is_the_share() {
        let before = scene();
        for share in [0.0, 0.2, 1.0] {
            let got = lost(&before, &applied(&RandomDropout { share }, &before));
            assert!((got - share).abs() < 0.02, "{share}: {got}");
        }
    }
}
