//! C9: the ground is not as level as in the plans.

use super::{Need, SensorEffect, Undulation, WorldPlan};
use data::KeyError;
use data::toml_text::within;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The ground and all that stands on it is `amplitude_m * sin(2 pi s / length_m + phase_rad)` higher than believed, m, s the way along the track.
/// Cars stay where their trajectories say, so that the ground under them moves against them.
///
/// Typical: some centimetres to a decimetre over 50 to 200 m.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct GroundError {
    /// m.
    pub amplitude_m: f64,
    /// m.
    pub length_m: f64,
    /// rad.
    pub phase_rad: f64,
}

impl Default for GroundError {
    fn default() -> Self {
        GroundError { amplitude_m: 0.05, length_m: 120.0, phase_rad: 0.0 }
    }
}

impl SensorEffect for GroundError {
    fn check(&self) -> Result<(), KeyError> {
        within("amplitude_m", self.amplitude_m, -2.0, 2.0)?;
        within("length_m", self.length_m, 5.0, 1e4)?;
        within("phase_rad", self.phase_rad, -100.0, 100.0)
    }

    fn needs(&self) -> Option<&'static [Need]> {
        None
    }

    fn on_world(&self, world: &mut WorldPlan) {
        let GroundError { amplitude_m, length_m, phase_rad } = *self;
        world.undulation = Some(Undulation { amplitude_m, length_m, phase_rad });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    // That the mesh then has these waves is tested with the track.
    #[test]
    fn the_world_gets_its_waves() {
        let mut world = WorldPlan::default();
        GroundError { amplitude_m: 0.1, length_m: 80.0, phase_rad: 1.0 }.on_world(&mut world);
        assert_eq!(world.undulation, Some(Undulation { amplitude_m: 0.1, length_m: 80.0, phase_rad: 1.0 }));
        assert!(GroundError { length_m: 0.0, ..GroundError::default() }.check().is_err());
    }
}
