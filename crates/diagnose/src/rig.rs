//! Where the sensors are. That is all that is needed of a rig to diagnose.

use data::DataError;
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion};
use serde::Deserialize;
use std::f64::consts::{PI, TAU};
use std::path::Path;

/// The sensors of a rig, in the cloud's frame. Keys that only a simulation needs (patterns, rates, limits) are not looked at.
#[derive(Clone, Debug, Deserialize)]
pub struct SensorRig {
    /// In the order of the file; their order is their number in findings.
    #[serde(rename = "sensor", default)]
    pub sensors: Vec<SensorMount>,
}

/// Place and direction of one sensor.
#[derive(Clone, Debug, Deserialize)]
pub struct SensorMount {
    /// Its name in findings.
    pub name: String,
    /// Origin of its rays in the cloud's frame, m.
    #[serde(default)]
    pub position: [f64; 3],
    /// Where its middle looks, degrees counter-clockwise from +x.
    #[serde(default)]
    pub yaw_deg: f64,
    /// Positive turns its middle down, degrees.
    #[serde(default)]
    pub pitch_deg: f64,
    /// Positive turns its left side up, degrees.
    #[serde(default)]
    pub roll_deg: f64,
    /// Region that it measures, degrees.
    #[serde(default = "all_around")]
    pub horizontal_fov_deg: f64,
    /// Scans a second.
    #[serde(default = "twenty")]
    pub rate_hz: f64,
}

fn all_around() -> f64 {
    360.0
}

fn twenty() -> f64 {
    20.0
}

impl SensorRig {
    /// Reads a rig.
    pub fn read(path: &Path) -> Result<Self, DataError> {
        Self::parse(&fs_err::read_to_string(path)?, path)
    }

    /// A rig in memory; `path` is for messages.
    pub fn parse(text: &str, path: &Path) -> Result<Self, DataError> {
        let rig: SensorRig = toml::from_str(text).map_err(|e| {
            let line = 1 + e.span().map_or(0, |span| text[..span.start.min(text.len())].matches('\n').count());
            DataError::line(path, line, e.message())
        })?;
        if rig.sensors.is_empty() {
            return Err(DataError::file(path, "has no [[sensor]]"));
        }
        if rig.sensors.len() > 64 {
            return Err(DataError::file(path, format!("has {} sensors, more than 64", rig.sensors.len())));
        }
        for (i, s) in rig.sensors.iter().enumerate() {
            let numbers = [s.yaw_deg, s.pitch_deg, s.roll_deg, s.rate_hz];
            if s.position.iter().any(|v| !(v.abs() <= 100.0)) || numbers.iter().any(|v| !(v.abs() <= 1e4)) {
                return Err(DataError::file(
                    path,
                    format!("sensor[{i}]: position within 100 m and finite angles are wanted"),
                ));
            }
            if !(s.horizontal_fov_deg > 0.0 && s.horizontal_fov_deg <= 360.0 && s.rate_hz > 0.0) {
                return Err(DataError::file(
                    path,
                    format!("sensor[{i}]: horizontal_fov_deg must be in (0, 360] and rate_hz positive"),
                ));
            }
        }
        Ok(rig)
    }

    /// One sensor at the frame's origin that sees everything.
    pub fn single() -> Self {
        let mount = SensorMount {
            name: "lidar".into(),
            position: [0.0; 3],
            yaw_deg: 0.0,
            pitch_deg: 0.0,
            roll_deg: 0.0,
            horizontal_fov_deg: 360.0,
            rate_hz: 20.0,
        };
        SensorRig { sensors: vec![mount] }
    }
}

/// Place in the scan of an azimuth of a sensor, -1/2 to +1/2, counter-clockwise.
pub fn scan_phase(azimuth_rad: f64, half_fov_rad: f64) -> f64 {
    azimuth_rad / (2.0 * half_fov_rad)
}

impl SensorMount {
    /// `cloud_from_sensor`: roll about x, then pitch about y, then yaw about z, then the position.
    pub fn pose(&self) -> Isometry3<f64> {
        let [roll, pitch, yaw] = [self.roll_deg, self.pitch_deg, self.yaw_deg].map(f64::to_radians);
        Isometry3::from_parts(Translation3::from(self.position), UnitQuaternion::from_euler_angles(roll, pitch, yaw))
    }

    /// Half of its field of view, rad.
    pub fn half_fov_rad(&self) -> f64 {
        (self.horizontal_fov_deg.to_radians() / 2.0).min(PI)
    }

    /// Whether it sees all around, so that its azimuth closes.
    pub fn closes(&self) -> bool {
        self.half_fov_rad() > 0.98 * PI
    }

    /// Azimuth (counter-clockwise from its middle), elevation, range of a point in its own frame: rad, rad, m.
    pub fn spherical(sensor_point: &Point3<f64>) -> [f64; 3] {
        let p = sensor_point.coords;
        let across = p.x.hypot(p.y);
        [p.y.atan2(p.x), p.z.atan2(across), p.norm()]
    }
}

/// `angle` moved into [-pi, pi).
pub fn wrapped(angle: f64) -> f64 {
    (angle + PI).rem_euclid(TAU) - PI
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rig_needs_only_places() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rig.toml");
        fs_err::write(
            &path,
            "[[sensor]]\nname = \"a\"\nposition = [1, 0, 2.5]\nyaw_deg = 90\npattern = { columns = 3 }\n",
        )
        .unwrap();
        let rig = SensorRig::read(&path).unwrap();
        let at = rig.sensors[0].pose() * Point3::new(2.0, 0.0, 0.0);
        assert!((at - Point3::new(1.0, 2.0, 2.5)).norm() < 1e-12 && rig.sensors[0].closes());
        for (text, want) in [
            ("", "rig.toml: has no [[sensor]]"),
            ("[[sensor]]\nposition = [0, 0, 0]\n", "rig.toml:1: missing field `name`"),
            ("[[sensor]]\nname = \"a\"\nposition = [nan, 0, 0]\n", "sensor[0]: position"),
            ("[[sensor]]\nname = \"a\"\nhorizontal_fov_deg = 0\n", "sensor[0]: horizontal_fov_deg"),
        ] {
            fs_err::write(&path, text).unwrap();
            let error = SensorRig::read(&path).unwrap_err().to_string();
            assert!(error.contains(want), "{text}: {error}");
        }
    }
}
