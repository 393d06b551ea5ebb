//! The GPS/IMU log of KITTI: a line of 30 numbers a frame, of which the first six are the pose of the IMU.

use crate::DataError;
use geometry::Pose;
use nalgebra::{Translation3, UnitQuaternion, Vector3};
use std::f64::consts::PI;
use std::path::Path;

/// Radius of the Earth in the Mercator projection of the development kit, m.
const EARTH_RADIUS_M: f64 = 6_378_137.0;

/// Latitude, longitude (degrees), altitude (m), roll, pitch and yaw (rad).
#[derive(Clone, Copy, Debug)]
pub(super) struct Oxts([f64; 6]);

impl Oxts {
    /// Parses a line. `path` and `line` (from 1) are used in error messages. A line of `nan` is not known: `None`.
    pub(super) fn parse(text: &str, path: &Path, line: usize) -> Result<Option<Oxts>, DataError> {
        let wrong = |message: String| DataError::line(path, line, message);
        let mut values = [0.0f64; 6];
        let mut words = text.split_ascii_whitespace();
        for (i, value) in values.iter_mut().enumerate() {
            let word = words.next().ok_or_else(|| {
                wrong(format!("has {i} values; latitude, longitude, altitude, roll, pitch and yaw are needed"))
            })?;
            *value = word.parse().map_err(|_| wrong(format!("{word:?} is not a number")))?;
        }
        if values.iter().all(|v| v.is_nan()) {
            return Ok(None);
        }
        let [latitude, longitude, altitude, angles @ ..] = values;
        if !(latitude.abs() < 89.0 && longitude.abs() <= 360.0 && altitude.abs() < 1e5) {
            return Err(wrong(format!("no place: latitude {latitude}, longitude {longitude}, altitude {altitude}")));
        }
        if let Some(angle) = angles.iter().find(|angle| !(angle.abs() <= 2.0 * PI)) {
            return Err(wrong(format!("roll, pitch and yaw are in rad; {angle} is more than a turn")));
        }
        Ok(Some(Oxts(values)))
    }

    /// The scale of the Mercator projection at this latitude.
    pub(super) fn mercator_scale(&self) -> f64 {
        (self.0[0] * PI / 180.0).cos()
    }

    /// The pose of the IMU in a frame with x east, y north, z up. The origin is far away: see [`Track::pose`].
    fn pose(&self, scale: f64) -> Pose {
        let [latitude, longitude, altitude, roll, pitch, yaw] = self.0;
        let x = scale * longitude * PI * EARTH_RADIUS_M / 180.0;
        let y = scale * EARTH_RADIUS_M * ((90.0 + latitude) * PI / 360.0).tan().ln();
        Pose::from_parts(Translation3::new(x, y, altitude), UnitQuaternion::from_euler_angles(roll, pitch, yaw))
    }
}

/// The frame of a drive: its first known pose gives the scale of the projection and the origin.
pub(super) struct Track {
    scale: f64,
    origin: Vector3<f64>,
    imu_from_lidar: Pose,
}

impl Track {
    /// The frame of a drive that begins with `first`. `imu_from_lidar` is the pose of the LiDAR on the vehicle.
    pub(super) fn new(first: &Oxts, imu_from_lidar: Pose) -> Track {
        let scale = first.mercator_scale();
        Track { scale, origin: first.pose(scale).translation.vector, imu_from_lidar }
    }

    /// The pose of the LiDAR frame in a frame with x east, y north, z up, whose origin is the first place of the IMU.
    pub(super) fn pose(&self, oxts: &Oxts) -> Pose {
        let mut pose = oxts.pose(self.scale);
        pose.translation.vector -= self.origin;
        pose * self.imu_from_lidar
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_become_poses() {
        let parse = |text: &str| Oxts::parse(text, Path::new("oxts/7.txt"), 1);
        let first = parse("49.0 8.4 116.0 0 0 0 1 2 3").unwrap().unwrap();
        let north = parse("49.0001 8.4 117.5 0 0 1.5707963267948966").unwrap().unwrap();
        let track = Track::new(&first, Pose::translation(1.0, 0.0, 0.0));
        let at = |oxts: &Oxts| track.pose(oxts).translation.vector;
        assert!((at(&first) - Vector3::new(1.0, 0.0, 0.0)).norm() < 1e-9);
        // 1e-4 degrees of latitude are 11.13 m; the lever of 1 m points north.
        assert!((at(&north) - Vector3::new(0.0, 12.13, 1.5)).norm() < 0.01, "{}", at(&north));
        assert!(parse("nan nan nan nan nan nan").unwrap().is_none());
        for (text, want) in [
            ("49 8.4 116", "oxts/7.txt:1: has 3 values"),
            ("49 8.4 116 0 0 north", "\"north\" is not a number"),
            ("49 8.4 116 0 0 90", "are in rad; 90 is more than a turn"),
            ("49 nan 116 0 0 1", "no place"),
        ] {
            let error = parse(text).unwrap_err().to_string();
            assert!(error.contains(want), "{error}");
        }
    }
}
