//! C9: an unmodelled undulation of the ground.

use super::{Need, SensorEffect, Undulation, WorldPlan};
use data::KeyError;
use data::toml_text::within;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The ground and all static objects on it are `amplitude_m * sin(2 pi s / length_m + phase_rad)` higher than modelled,
/// m, s the arc length along the track's centre line, m. Cars keep the heights of their trajectories, so that the
/// ground moves relative to them.
///
/// Typical: a few centimetres (0.05 m) to a decimetre over 50 to 200 m.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct GroundError {
    /// Amplitude, m.
    pub amplitude_m: f64,
    /// Wavelength along the centre line, m; rounded so that a lap has a whole number of waves.
    pub length_m: f64,
    /// Phase at the start of the centre line, rad.
    pub phase_rad: f64,
}

impl Default for GroundError {
    fn default() -> Self {
        GroundError { amplitude_m: 0.0, length_m: 120.0, phase_rad: 0.0 }
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
        if amplitude_m != 0.0 {
            world.undulation = Some(Undulation { amplitude_m, length_m, phase_rad });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    // The undulation of the mesh is tested with the track.
    #[test]
    fn the_world_plan_gets_the_undulation() {
        let mut world = WorldPlan::default();
        GroundError { amplitude_m: 0.1, length_m: 80.0, phase_rad: 1.0 }.on_world(&mut world);
        assert_eq!(world.undulation, Some(Undulation { amplitude_m: 0.1, length_m: 80.0, phase_rad: 1.0 }));
        assert!(GroundError { length_m: 0.0, ..GroundError::default() }.check().is_err());
    }
}
