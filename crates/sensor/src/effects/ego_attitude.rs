//! C8: error of the ego vehicle's roll, pitch and height.

use super::reshoot::reshoot;
use super::{Draws, FrameContext, Need, SensorEffect};
use crate::beams::Beams;
use crate::scan::Scan;
use data::KeyError;
use data::toml_text::within;
use geometry::Pose;
use nalgebra::{Translation3, UnitQuaternion};
use rand_distr::{Distribution, StandardNormal};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The true attitude of the ego vehicle differs from the reported one by roll `roll_deg + roll_std_deg * N(0, 1)` and
/// pitch `pitch_deg + pitch_at_70mps_deg * (v / 70)^2 + pitch_std_deg * N(0, 1)`, v the ego speed, m/s. Positive pitch
/// turns the nose down. The true height differs by `heave_std_m * N(0, 1)`. Values are drawn anew in every frame.
/// Points are computed with the reported pose, so the whole cloud is rotated and shifted relative to labels and world.
///
/// Typical: 0.1 to 0.3 degrees of pitch from braking, aerodynamic load (with the square of the speed) and bumps;
/// standard deviations of 0.05 degrees.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct EgoAttitude {
    /// Mean roll error, degrees; positive turns the left side up.
    pub roll_deg: f64,
    /// Mean pitch error at standstill, degrees; positive turns the nose down.
    pub pitch_deg: f64,
    /// Additional pitch error at 70 m/s from aerodynamic load, degrees; it grows with the square of the speed.
    pub pitch_at_70mps_deg: f64,
    /// Standard deviation of roll between frames, degrees.
    pub roll_std_deg: f64,
    /// Standard deviation of pitch between frames, degrees.
    pub pitch_std_deg: f64,
    /// Standard deviation of the height between frames, m.
    pub heave_std_m: f64,
}

impl SensorEffect for EgoAttitude {
    fn check(&self) -> Result<(), KeyError> {
        for (key, value) in [
            ("roll_deg", self.roll_deg),
            ("pitch_deg", self.pitch_deg),
            ("pitch_at_70mps_deg", self.pitch_at_70mps_deg),
        ] {
            within(key, value, -20.0, 20.0)?;
        }
        within("roll_std_deg", self.roll_std_deg, 0.0, 10.0)?;
        within("pitch_std_deg", self.pitch_std_deg, 0.0, 10.0)?;
        within("heave_std_m", self.heave_std_m, 0.0, 1.0)
    }

    fn needs(&self) -> Option<&'static [Need]> {
        Some(if self.pitch_at_70mps_deg == 0.0 { &[] } else { &[Need::Motion] })
    }

    fn on_beams(&self, beams: &mut Beams, frame: &FrameContext, draws: &Draws) {
        let (tilt, heave_m) = self.of_frame(frame, draws);
        beams.ego_tilt *= tilt;
        beams.ego_heave_m += heave_m;
    }

    /// Ranges are those of the true rays, looked up in the cloud.
    fn on_cloud(&self, scan: &mut Scan, frame: &FrameContext, draws: &Draws) {
        let (tilt, heave_m) = self.of_frame(frame, draws);
        if tilt == UnitQuaternion::identity() && heave_m == 0.0 {
            return;
        }
        let true_from_reported = Pose::from_parts(Translation3::new(0.0, 0.0, heave_m), tilt);
        reshoot(scan, frame, draws, |_, _| Some(true_from_reported));
    }
}

impl EgoAttitude {
    /// Attitude error of the ego vehicle in a frame, and its height error, m.
    fn of_frame(&self, frame: &FrameContext, draws: &Draws) -> (UnitQuaternion<f64>, f64) {
        let mut random = draws.of_frame();
        let [roll, pitch, heave]: [f64; 3] = std::array::from_fn(|_| StandardNormal.sample(&mut random));
        let speed = frame.ego_velocity.iter().map(|v| v * v).sum::<f64>().sqrt();
        let roll_deg = self.roll_deg + self.roll_std_deg * roll;
        let pitch_deg = self.pitch_deg + self.pitch_at_70mps_deg * (speed / 70.0).powi(2) + self.pitch_std_deg * pitch;
        let tilt = UnitQuaternion::from_euler_angles(roll_deg.to_radians(), pitch_deg.to_radians(), 0.0);
        (tilt, self.heave_std_m * heave)
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn a_nose_down_error_raises_points_ahead() {
        let still = EgoAttitude { pitch_deg: 0.5, ..EgoAttitude::default() };
        let before = scene();
        let mut after = before.clone();
        with_frame(0, |frame, draws| still.on_cloud(&mut after, frame, draws));
        let mut ahead = 0;
        for (a, b) in before.returns().zip(after.returns()) {
            let (p, q) = (a.point().map(f64::from), b.point().map(f64::from));
            let lifted = 0.5f64.to_radians() * p[0];
            assert!((q[2] - p[2] - lifted).abs() < 0.01 * lifted.abs() + 2e-3, "{p:?} {q:?}");
            ahead += usize::from(p[0] > 1.0);
        }
        assert!(ahead > 10);
    }

    #[test]
    fn attitude_errors_have_the_configured_moments() {
        let effect = EgoAttitude {
            roll_deg: 0.2,
            pitch_deg: -0.1,
            pitch_at_70mps_deg: 0.49,
            roll_std_deg: 0.05,
            pitch_std_deg: 0.1,
            heave_std_m: 0.02,
        };
        let tilts: Vec<[f64; 3]> = (0..3000)
            .map(|frame| {
                let mut beams = Beams::of(&rig());
                with_frame(frame, |frame, draws| effect.on_beams(&mut beams, frame, draws));
                let (roll, pitch, _) = beams.ego_tilt.euler_angles();
                [roll.to_degrees(), pitch.to_degrees(), beams.ego_heave_m]
            })
            .collect();
        // At 50 m/s the aerodynamic term is (50 / 70)^2 of its value at 70 m/s: 0.25 degrees.
        for (k, mean, std) in [(0, 0.2, 0.05), (1, 0.15, 0.1), (2, 0.0, 0.02)] {
            let (m, s) = moments(&tilts.iter().map(|t| t[k]).collect::<Vec<_>>());
            assert!((m - mean).abs() < 0.1 * std && (s / std - 1.0).abs() < 0.05, "{k}: {m} {s}");
        }
    }
}
