//! D1: beam divergence, which gives mixed ranges at edges.

use super::{Draws, FrameContext, Need, SensorEffect};
use crate::beams::{BeamWidth, Beams, Pick};
use data::KeyError;
use data::toml_text::{within, wrong};
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
        None
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
