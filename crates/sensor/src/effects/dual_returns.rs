//! D6: two returns per shot.

use super::{Draws, FrameContext, Need, SensorEffect};
use crate::beams::Beams;
use data::KeyError;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The strongest of the returns that [`super::BeamDivergence`] does not select is reported as a second return.
/// `beam_divergence` must be before this effect in the list, because a shot without divergence has one return.
///
/// Typical: a mode of most sensors; two points per direction at edges and fences.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct DualReturns {}

impl SensorEffect for DualReturns {
    fn check(&self) -> Result<(), KeyError> {
        Ok(())
    }

    fn needs(&self) -> Option<&'static [Need]> {
        None
    }

    fn on_beams(&self, beams: &mut Beams, _frame: &FrameContext, _draws: &Draws) {
        if let Some(width) = &mut beams.width {
            width.second = true;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::{BeamDivergence, testing::*};
    use super::*;

    // That second returns occur at edges only is tested with the scene.
    #[test]
    fn divergent_beams_report_a_second_return() {
        let mut beams = Beams::of(&rig());
        with_frame(0, |frame, draws| {
            DualReturns {}.on_beams(&mut beams, frame, draws);
            assert_eq!(beams.width, None, "a shot without divergence has one return");
            BeamDivergence { divergence_rad: 0.002, ..BeamDivergence::default() }.on_beams(&mut beams, frame, draws);
            DualReturns {}.on_beams(&mut beams, frame, draws);
        });
        assert!(beams.width.unwrap().second);
    }
}
