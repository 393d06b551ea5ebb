//! C4: motion distortion within a scan.

use super::reshoot::reshoot;
use super::{Draws, FrameContext, Need, SensorEffect};
use crate::beams::{Beams, Shutter};
use crate::rig::Sensor;
use crate::scan::{Echo, Scan};
use data::KeyError;
use data::toml_text::within;
use geometry::Pose;
use nalgebra::{Translation3, UnitQuaternion, Vector3};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Every shot is sent at its own time. It meets other cars at their poses of that time and starts from the ego pose of
/// that time. With `deskewed = true`, points are corrected for ego motion to the middle of the scan, as sensor drivers
/// do: static surfaces are correct, and moving cars keep the distortion by their own velocity. With `deskewed = false`,
/// all points are distorted by the velocity relative to the ego vehicle.
///
/// Typical: 50 ms per scan; at 70 m/s that is +-1.75 m.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RollingShutter {
    /// Correct points for ego motion to the middle of the scan.
    pub deskewed: bool,
    /// Duration of a scan on finished clouds, s: shots are sent along the sensor's scan, clockwise where it is
    /// positive. Without it the times of the shots are taken.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scan_s: Option<f64>,
    /// With `scan_s`: what shots at a quarter of the scan are early by and those at three quarters late, as a share of
    /// its duration, beyond even motion. Mirrors that swing are fastest in the middle of a scan.
    #[serde(default, skip_serializing_if = "is_even")]
    pub uneven: f64,
    /// On finished clouds, displace labelled objects alone, by their velocities relative to the ego vehicle.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub only_objects: bool,
    /// Displacement of all that stands still over a scan of a finished cloud, in place of that by the ego motion:
    /// forward and to the left, m, and turn, degrees counter-clockwise.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub slide: Option<[f64; 3]>,
}

fn is_even(uneven: &f64) -> bool {
    *uneven == 0.0
}

impl RollingShutter {
    /// Largest unevenness of a scan that never turns back.
    pub const MOST_UNEVEN: f64 = 0.15;
}

impl SensorEffect for RollingShutter {
    fn check(&self) -> Result<(), KeyError> {
        within("scan_s", self.scan_s.unwrap_or(0.0), -1.0, 1.0)?;
        within("uneven", self.uneven, -Self::MOST_UNEVEN, Self::MOST_UNEVEN)?;
        let slide = self.slide.unwrap_or_default();
        slide.iter().enumerate().try_for_each(|(k, v)| within(&format!("slide[{k}]"), *v, -100.0, 100.0))
    }

    fn needs(&self) -> Option<&'static [Need]> {
        Some(match (self.slide, self.scan_s) {
            (Some(_), _) => &[],
            (None, Some(_)) if self.only_objects => &[Need::Cars, Need::SeenMotion],
            (None, Some(_)) => &[Need::Cars, Need::Motion],
            (None, None) => &[Need::Time, Need::Cars, Need::Motion],
        })
    }

    fn on_beams(&self, beams: &mut Beams, _frame: &FrameContext, _draws: &Draws) {
        beams.shutter = Some(Shutter { deskewed: self.deskewed });
    }

    /// On a finished cloud, points within the boxes of cars move with the velocity of their car. With
    /// `deskewed = false` the velocity of the ego vehicle at the point is subtracted, and shots at all that stands
    /// still start where the ego vehicle is at their time.
    fn on_cloud(&self, scan: &mut Scan, frame: &FrameContext, draws: &Draws) {
        let mounts: Vec<_> = frame.rig.sensors.iter().map(|s| (s, s.pose().inverse())).collect();
        let phase = |echo: &Echo| {
            let (sensor, sensor_from_cloud) = &mounts[usize::from(echo.sensor)];
            let own = sensor_from_cloud.rotation * Vector3::from(echo.direction.map(f64::from));
            sensor.scan_phase(own.y.atan2(own.x), own.z.atan2(own.x.hypot(own.y)))
        };
        let moved_by = |way: Vector3<f64>, turn: Vector3<f64>| {
            Pose::from_parts(Translation3::from(way), UnitQuaternion::from_scaled_axis(turn))
        };
        if let Some([forward_m, left_m, turn_deg]) = self.slide {
            let (way, turn) = (Vector3::new(forward_m, left_m, 0.0), Vector3::z() * turn_deg.to_radians());
            // The scene slides one way, the origins of the shots the other.
            reshoot(scan, frame, draws, |_, echo| Some(moved_by(-way * phase(echo), -turn * phase(echo))));
            return;
        }
        let late = |echo: &Echo| phase(echo) + self.uneven * Sensor::uneven_phase(phase(echo));
        let time_s = |echo: &Echo| self.scan_s.map_or(f64::from(echo.time_s), |scan_s| -scan_s * late(echo));
        let (ego, turn) = (Vector3::from(frame.ego_velocity), Vector3::from(frame.ego_turn_rate));
        let car_at = |echo: &Echo| {
            let point = echo.point().map(f64::from);
            let inside = |b: &geometry::Box3| {
                let local = b.to_local(point);
                (0..3).all(|k| local[k].abs() <= b.size[k] / 2.0 + 0.1)
            };
            frame.cars.iter().find(|car| echo.is_return() && inside(&car.true_box))
        };
        // Cars first: afterwards their points are no longer in their boxes.
        let of_car: Vec<bool> = scan.echoes.iter().map(|echo| car_at(echo).is_some()).collect();
        for echo in scan.echoes.iter_mut() {
            let Some(car) = car_at(echo) else { continue };
            let point = Vector3::from(echo.point().map(f64::from));
            let own = if self.deskewed { Vector3::zeros() } else { ego + turn.cross(&point) };
            let way = (Vector3::from(car.velocity) - own) * time_s(echo);
            if way != Vector3::zeros() {
                echo.move_point((point + way).map(|v| v as f32).into());
            }
        }
        if !self.deskewed && !self.only_objects && (ego != Vector3::zeros() || turn != Vector3::zeros()) {
            // Points of cars keep their place: they are no longer looked at.
            let cars: Vec<Echo> = scan.echoes.iter().zip(&of_car).filter(|(_, car)| **car).map(|(e, _)| *e).collect();
            let mut at = of_car.iter();
            scan.echoes.retain(|_| at.next() != Some(&true));
            reshoot(scan, frame, draws, |_, echo| Some(moved_by(ego * time_s(echo), turn * time_s(echo))));
            scan.echoes.extend(cars);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;
    use crate::scan::Echo;

    /// A point of the car of `cars()` and one beside, both shot at 20 ms.
    fn two() -> Scan {
        let at = |point: [f32; 3]| {
            let mut echo = Echo { time_s: 0.02, range_m: 1.0, ..Echo::nothing([0.0; 3], [1.0, 0.0, 0.0]) };
            echo.move_point(point);
            echo
        };
        Scan { echoes: vec![at([19.0, 2.0, -1.0]), at([30.0, -8.0, 0.0])] }
    }

    fn shutter(deskewed: bool) -> RollingShutter {
        RollingShutter { deskewed, scan_s: None, uneven: 0.0, only_objects: false, slide: None }
    }

    #[test]
    fn a_slide_needs_no_motion_and_a_duration_no_times() {
        let before = scene();
        let slid = RollingShutter { slide: Some([1.2, 0.0, 0.0]), ..shutter(false) };
        assert_eq!(slid.needs(), Some(&[][..]));
        let mut after = before.clone();
        with_frame(0, |frame, draws| slid.on_cloud(&mut after, frame, draws));
        let rig = rig();
        let phase = |e: &Echo| {
            let [x, y, z] = e.direction.map(f64::from);
            rig.sensors[0].scan_phase(y.atan2(x), z.atan2(x.hypot(y)))
        };
        for (a, b) in after.returns().zip(before.returns()) {
            assert!((f64::from(a.point()[0] - b.point()[0]) - 1.2 * phase(b)).abs() < 1e-3);
        }
        // 50 m/s and 0.1 s: what stands still comes nearer by 5 m over a scan, from its begin at phase 1/2 on.
        let timed = RollingShutter { scan_s: Some(0.1), ..shutter(false) };
        let still = before.returns().map(|e| e.object != 1).collect::<Vec<_>>();
        let mut after = before.clone();
        with_frame(0, |frame, draws| timed.on_cloud(&mut after, frame, draws));
        for ((a, b), _) in after.returns().zip(before.returns()).zip(still).filter(|(_, wall)| *wall) {
            // The turn of 0.2 rad/s adds up to 0.5 m at the ends of the wall.
            let moved = f64::from(a.point()[0] - b.point()[0]);
            assert!((moved - 5.0 * phase(b)).abs() < 0.8, "{moved} at phase {}", phase(b));
        }
    }

    #[test]
    fn deskewed_only_cars_move() {
        let mut scan = two();
        with_frame(0, |frame, draws| shutter(true).on_cloud(&mut scan, frame, draws));
        let (s, c) = 0.1_f32.sin_cos();
        let (on_car, beside) = (scan.echoes[0].point(), scan.echoes[1].point());
        assert!((on_car[0] - 19.0 - 1.2 * c).abs() < 1e-4 && (on_car[1] - 2.0 - 1.2 * s).abs() < 1e-4);
        assert!((beside[0] - 30.0).abs() < 1e-4);
    }

    #[test]
    fn without_deskewing_all_points_move_relative_to_the_ego_vehicle() {
        let mut scan = two();
        with_frame(0, |frame, draws| shutter(false).on_cloud(&mut scan, frame, draws));
        // Cars come last.
        let beside = scan.echoes[0].point();
        // 50 m/s forward and 0.2 rad/s to the left for 20 ms.
        assert!(
            (beside[0] - (30.0 - 1.0 - 0.2 * 8.0 * 0.02)).abs() < 6e-3
                && (beside[1] - (-8.0 - 0.2 * 30.0 * 0.02)).abs() < 6e-3,
            "{beside:?}"
        );
    }

    #[test]
    fn the_shutter_is_set_on_the_beams() {
        let mut beams = Beams::of(&rig());
        with_frame(0, |frame, draws| shutter(false).on_beams(&mut beams, frame, draws));
        assert_eq!(beams.shutter, Some(Shutter { deskewed: false }));
    }
}
