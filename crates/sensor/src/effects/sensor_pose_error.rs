//! C2: a wrong sensor pose (extrinsic calibration) in the rig.

use super::reshoot::reshoot;
use super::{Draws, FrameContext, SensorEffect};
use crate::beams::Beams;
use crate::scan::Scan;
use data::KeyError;
use data::toml_text::within;
use geometry::Pose;
use nalgebra::{Isometry3, Translation3, UnitQuaternion};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The true pose of the sensor is its pose in the rig, shifted by `translation_m` and rotated by `rotation_deg`, both
/// in the sensor's frame. Points are computed with the pose in the rig.
///
/// Typical: 1 to 10 cm, 0.05 to 0.3 degrees. The published description of the AV-21 has two values for the front
/// sensor, 10 cm apart in x.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SensorPoseError {
    /// Name of the sensor; empty for none.
    pub sensor: String,
    /// Shift forward, left, up in the sensor's frame, m.
    pub translation_m: [f64; 3],
    /// Roll, pitch, yaw, degrees: about x, then y, then z. Positive pitch turns the sensor down.
    pub rotation_deg: [f64; 3],
}

impl SensorPoseError {
    /// `nominal_from_true` of the sensor's frame.
    pub fn error(&self) -> Pose {
        let [roll, pitch, yaw] = self.rotation_deg.map(f64::to_radians);
        Isometry3::from_parts(
            Translation3::from(self.translation_m),
            UnitQuaternion::from_euler_angles(roll, pitch, yaw),
        )
    }
}

impl SensorEffect for SensorPoseError {
    fn sensor(&self) -> &str {
        &self.sensor
    }

    fn check(&self) -> Result<(), KeyError> {
        for k in 0..3 {
            within(&format!("translation_m[{k}]"), self.translation_m[k], -5.0, 5.0)?;
            within(&format!("rotation_deg[{k}]"), self.rotation_deg[k], -45.0, 45.0)?;
        }
        Ok(())
    }

    fn on_beams(&self, beams: &mut Beams, frame: &FrameContext, _draws: &Draws) {
        if let Some(sensor) = frame.rig.find(&self.sensor).and_then(|i| beams.sensors.get_mut(i)) {
            sensor.true_mount *= self.error();
        }
    }

    /// Ranges are those of the true rays, looked up in the cloud.
    fn on_cloud(&self, scan: &mut Scan, frame: &FrameContext, draws: &Draws) {
        if (self.translation_m, self.rotation_deg) == ([0.0; 3], [0.0; 3]) {
            return;
        }
        let Some(number) = frame.rig.find(&self.sensor) else { return };
        let mount = frame.rig.sensors[number].pose();
        let true_from_reported = mount * self.error() * mount.inverse();
        reshoot(scan, frame, draws, |_, echo| (usize::from(echo.sensor) == number).then_some(true_from_reported));
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn the_true_mount_moves_and_the_nominal_one_stays() {
        let effect =
            SensorPoseError { sensor: "front".into(), translation_m: [0.1, 0.0, 0.0], rotation_deg: [0.0, 0.0, 1.0] };
        let mut beams = Beams::of(&rig());
        with_frame(0, |frame, draws| effect.on_beams(&mut beams, frame, draws));
        let sensor = &beams.sensors[0];
        assert!((sensor.true_mount.translation.x - 0.1).abs() < 1e-12 && sensor.nominal_mount.translation.x == 0.0);
        assert!((geometry::yaw_rad(&sensor.true_mount).to_degrees() - 1.0).abs() < 1e-9);
    }

    #[test]
    fn a_sensor_pitched_down_raises_the_ground() {
        let before = scene();
        let effect = SensorPoseError { sensor: "front".into(), translation_m: [0.0; 3], rotation_deg: [0.0, 0.5, 0.0] };
        let mut after = before.clone();
        with_frame(0, |frame, draws| effect.on_cloud(&mut after, frame, draws));
        let slope = 0.5_f32.to_radians().tan();
        for (a, b) in before.echoes.iter().zip(&after.echoes).filter(|(a, _)| a.is_return() && a.object == 1) {
            let (p, q) = (a.point(), b.point());
            assert!((q[2] - p[2] - p[0] * slope).abs() < 2e-3, "{p:?} {q:?}");
        }
    }
}
