//! C1: random direction errors of single shots.

use super::reshoot::reaim;
use super::{Draws, FrameContext, Need, SensorEffect};
use crate::beams::{Beams, turned};
use crate::scan::Scan;
use data::KeyError;
use data::Stream;
use data::toml_text::within;
use rand_distr::{Distribution, StandardNormal};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The true direction of every shot differs from the nominal one by `azimuth_std_deg * N(0, 1)` in azimuth and
/// `elevation_std_deg * N(0, 1)` in elevation. The range is measured in the true direction and reported in the nominal
/// one. On a finished cloud the range in the true direction is that of the plane through the neighbouring points, and
/// at an edge that of the surface that is met there.
///
/// Typical: 0.01 to 0.03 degrees (Ouster OS1 +-0.01, NVIDIA Isaac 0.025, Robotec's GPU LiDAR 1 mrad).
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct AngularJitter {
    /// Standard deviation of the azimuth error, degrees.
    pub azimuth_std_deg: f64,
    /// Standard deviation of the elevation error, degrees.
    pub elevation_std_deg: f64,
}

impl AngularJitter {
    fn turn(&self, direction: [f32; 3], random: &mut Stream) -> [f32; 3] {
        let [left, up]: [f32; 2] = [StandardNormal.sample(random), StandardNormal.sample(random)];
        let [azimuth, elevation] = [self.azimuth_std_deg, self.elevation_std_deg].map(|v| v.to_radians() as f32);
        turned(direction, azimuth * left, elevation * up)
    }
}

impl SensorEffect for AngularJitter {
    fn check(&self) -> Result<(), KeyError> {
        within("azimuth_std_deg", self.azimuth_std_deg, 0.0, 5.0)?;
        within("elevation_std_deg", self.elevation_std_deg, 0.0, 5.0)
    }

    fn needs(&self) -> Option<&'static [Need]> {
        Some(&[Need::Incidence])
    }

    fn on_beams(&self, beams: &mut Beams, _frame: &FrameContext, draws: &Draws) {
        if *self == AngularJitter::default() {
            return;
        }
        let mut random = draws.of_frame();
        for sensor in &mut beams.sensors {
            for direction in sensor.true_directions_mut() {
                *direction = self.turn(*direction, &mut random);
            }
        }
    }

    fn on_cloud(&self, scan: &mut Scan, frame: &FrameContext, draws: &Draws) {
        if *self == AngularJitter::default() {
            return;
        }
        let mut random = draws.of_frame();
        reaim(scan, frame, draws, |echo| self.turn(echo.direction, &mut random));
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn direction_errors_have_the_configured_deviation() {
        let effect = AngularJitter { azimuth_std_deg: 0.05, elevation_std_deg: 0.02 };
        let mut beams = Beams::of(&rig());
        with_frame(0, |frame, draws| effect.on_beams(&mut beams, frame, draws));
        let sensor = &beams.sensors[0];
        let angle = |d: &[f32; 3]| (f64::from(d[1].atan2(d[0])).to_degrees(), f64::from(d[2].asin()).to_degrees());
        let off: Vec<(f64, f64)> = sensor
            .nominal_directions
            .iter()
            .zip(&sensor.true_directions)
            .map(|(a, b)| {
                let ((az, el), (az2, el2)) = (angle(a), angle(b));
                (az2 - az, el2 - el)
            })
            .collect();
        let (mean, azimuth) = moments(&off.iter().map(|o| o.0).collect::<Vec<_>>());
        let (_, elevation) = moments(&off.iter().map(|o| o.1).collect::<Vec<_>>());
        assert!(
            mean.abs() < 3e-3 && (azimuth - 0.05).abs() < 3e-3 && (elevation - 0.02).abs() < 2e-3,
            "{azimuth} {elevation}"
        );
        assert_ne!(&sensor.nominal_directions[..], &sensor.true_directions[..]);
    }

    #[test]
    fn ranges_of_a_finished_cloud_follow_the_local_plane() {
        let effect = AngularJitter { azimuth_std_deg: 0.0, elevation_std_deg: 0.02 };
        let before = scene();
        let mut after = before.clone();
        with_frame(0, |frame, draws| effect.on_cloud(&mut after, frame, draws));
        // An angular error e changes the range by R * tan(incidence) * e: almost nothing at normal incidence.
        let off = |object: u16, size: &dyn Fn(&crate::scan::Echo) -> f64| {
            let both = before.echoes.iter().zip(&after.echoes).filter(|(a, _)| a.is_return() && a.object == object);
            both.map(|(a, b)| f64::from(b.range_m - a.range_m) / size(a)).collect::<Vec<_>>()
        };
        let one = 0.02_f64.to_radians();
        let tan = |c: f64| (1.0 - c * c).sqrt() / c;
        let (_, ground) = moments(&off(1, &|a| f64::from(a.range_m) * tan(a.cos_incidence.into()) * one));
        assert!((ground - 1.0).abs() < 0.05, "{ground}");
        let (_, wall) = moments(&off(4, &|_| 1.0));
        assert!(wall < 8e-3, "{wall}");
    }
}
