//! D6: two returns a shot.

use super::{Draws, FrameContext, Need, SensorEffect};
use crate::beams::Beams;
use data::KeyError;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The strongest of the returns that [`super::BeamDivergence`] (which must stand before it) does not report is reported too.
///
/// Typical: a mode of most sensors; two points a direction at edges and fences.
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

    // That seconds come back at edges alone is tested with the scene.
    #[test]
    fn wide_beams_report_a_second() {
        let mut beams = Beams::of(&rig());
        with_frame(0, |frame, draws| {
            DualReturns {}.on_beams(&mut beams, frame, draws);
            assert_eq!(beams.width, None, "a line has one return");
            BeamDivergence::default().on_beams(&mut beams, frame, draws);
            DualReturns {}.on_beams(&mut beams, frame, draws);
        });
        assert!(beams.width.unwrap().second);
    }
}
