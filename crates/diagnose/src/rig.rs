//! Where the sensors are. That is all that is needed of a rig to diagnose.

use data::DataError;
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion};
use serde::{Deserialize, Deserializer};
use std::f64::consts::{PI, TAU};
use std::path::Path;

/// The sensors of a rig, in the cloud's frame. Keys that only a simulation needs (columns, limits) are not looked at.
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
    /// Blocks of rows that a scan finishes one after the other, from the top; empty where time runs along azimuth, as in sensors that spin.
    #[serde(default, rename = "pattern", deserialize_with = "rows_in_turn")]
    pub rows_in_turn: Vec<RowBlock>,
}

/// Rows of a sensor at equal angles.
#[derive(Clone, Copy, Debug, Deserialize)]
pub struct RowBlock {
    /// Number of rows.
    pub rows: f64,
    /// Elevation of the first, degrees.
    pub top_deg: f64,
    /// Elevation of the last, degrees.
    pub bottom_deg: f64,
}

/// Reads the pattern of a simulated sensor (`blocks`, `sweep`); what other tools call a pattern says nothing.
fn rows_in_turn<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<RowBlock>, D::Error> {
    #[derive(Deserialize)]
    struct Pattern {
        blocks: Vec<RowBlock>,
        #[serde(default)]
        sweep: Option<String>,
    }
    let pattern: Option<Pattern> = toml::Value::deserialize(deserializer)?.try_into().ok();
    let in_turn = pattern.filter(|p| p.sweep.as_deref().is_none_or(|s| s == "rows"));
    Ok(in_turn.map_or(vec![], |p| p.blocks))
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
            let level = |b: &RowBlock| {
                (1.0..=4096.0).contains(&b.rows) && b.top_deg.abs() <= 90.0 && b.bottom_deg.abs() <= 90.0
            };
            if !s.rows_in_turn.iter().all(level) {
                return Err(DataError::file(
                    path,
                    format!("sensor[{i}]: pattern.blocks want rows from 1 to 4096 and angles within 90 degrees"),
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
            rows_in_turn: vec![],
        };
        SensorRig { sensors: vec![mount] }
    }
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

    /// Place in the scan of a direction in its own frame, from +1/2 where a scan begins, on the left or at the top, to -1/2.
    pub fn scan_phase(&self, azimuth_rad: f64, elevation_rad: f64) -> f64 {
        let all: f64 = self.rows_in_turn.iter().map(|b| b.rows).sum();
        if all == 0.0 {
            return azimuth_rad / (2.0 * self.half_fov_rad());
        }
        let done = |b: &RowBlock| {
            let step_deg = ((b.top_deg - b.bottom_deg) / (b.rows - 1.0).max(1.0)).max(1e-9);
            ((b.top_deg - elevation_rad.to_degrees()) / step_deg + 0.5).clamp(0.0, b.rows)
        };
        0.5 - self.rows_in_turn.iter().map(done).sum::<f64>() / all
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
    fn time_runs_along_azimuth_or_row_after_row() {
        let rig = |pattern: &str| {
            let text = format!("[[sensor]]\nname = \"a\"\nhorizontal_fov_deg = 120\n{pattern}");
            SensorRig::parse(&text, Path::new("rig.toml")).unwrap().sensors.remove(0)
        };
        let spins = rig("pattern = { blocks = [{ rows = 64, top_deg = 6, bottom_deg = -19 }], sweep = \"columns\" }\n");
        for mount in [rig(""), rig("pattern = \"spiral\"\n"), spins] {
            assert!((mount.scan_phase(1f64.to_radians() * 30.0, 0.3) - 0.25).abs() < 1e-12);
        }
        // Three quarters of the rows lie above the horizon.
        let blocks =
            "[{ rows = 30, top_deg = 10, bottom_deg = 0.0 }, { rows = 10, top_deg = -0.5, bottom_deg = -20.5 }]";
        let rows = rig(&format!("pattern = {{ blocks = {blocks}, columns = 400 }}\n"));
        for (elevation_deg, phase) in
            [(12.0, 0.5), (10.0, 0.4875), (5.0, 0.125), (-0.5, -0.2625), (-10.5, -0.375), (-30.0, -0.5)]
        {
            assert!((rows.scan_phase(0.7, f64::to_radians(elevation_deg)) - phase).abs() < 1e-12, "{elevation_deg}");
        }
    }

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
