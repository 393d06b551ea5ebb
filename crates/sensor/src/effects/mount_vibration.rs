//! E2: vibration of the sensor mounts.

use super::{Draws, FrameContext, Need, SensorEffect};
use crate::beams::Beams;
use data::KeyError;
use data::toml_text::within;
use nalgebra::UnitQuaternion;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The true pitch of all sensors differs from the rig by `amplitude_deg * sin(2 pi * frequency_hz * t)`, t the time of
/// the cloud, s. The angle is the same for all shots of a scan. The effect is not in the usual catalogues; it tests a
/// diagnosis on unknown causes.
///
/// Typical: 0.05 to 0.3 degrees at 1 to 30 Hz.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct MountVibration {
    /// Amplitude of the pitch, degrees.
    pub amplitude_deg: f64,
    /// Frequency, Hz.
    pub frequency_hz: f64,
}

impl Default for MountVibration {
    fn default() -> Self {
        MountVibration { amplitude_deg: 0.0, frequency_hz: 1.7 }
    }
}

impl SensorEffect for MountVibration {
    fn check(&self) -> Result<(), KeyError> {
        within("amplitude_deg", self.amplitude_deg, 0.0, 10.0)?;
        within("frequency_hz", self.frequency_hz, 0.0, 1e4)
    }

    fn needs(&self) -> Option<&'static [Need]> {
        None
    }

    fn on_beams(&self, beams: &mut Beams, frame: &FrameContext, _draws: &Draws) {
        let phase = std::f64::consts::TAU * self.frequency_hz * frame.time_s;
        let pitch = self.amplitude_deg.to_radians() * phase.sin();
        for sensor in &mut beams.sensors {
            sensor.true_mount.rotation *= UnitQuaternion::from_euler_angles(0.0, pitch, 0.0);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn the_pitch_is_a_sine_of_time() {
        let effect = MountVibration { amplitude_deg: 0.2, frequency_hz: 5.0 };
        let pitch = |index: u64| {
            let mut beams = Beams::of(&rig());
            with_frame(index, |frame, draws| effect.on_beams(&mut beams, frame, draws));
            beams.sensors[0].true_mount.rotation.euler_angles().1.to_degrees()
        };
        // Frames are 50 ms apart: a quarter of the period.
        for (index, want) in [(0, 0.0), (1, 0.2), (2, 0.0), (3, -0.2), (4, 0.0)] {
            assert!((pitch(index) - want).abs() < 1e-9, "{index}: {}", pitch(index));
        }
    }
}
