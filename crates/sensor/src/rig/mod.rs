//! Sensor rigs: mounts, fields of view and scan patterns.

mod pattern;

use pattern::MOST_SHOTS;
pub use pattern::{Pattern, RowBlock, Shot, Sweep, direction};

use data::limits::check_name;
use data::toml_text::{parse_toml, read_toml, within, wrong};
use data::{DataError, KeyError};
use geometry::Pose;
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::f64::consts::PI;
use std::path::Path;

/// The sensors of a vehicle. Their poses are relative to the frame of its clouds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Rig {
    /// The sensors. Their index is the number in attributes.
    #[serde(rename = "sensor", default)]
    pub sensors: Vec<Sensor>,
}

/// One LiDAR.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Sensor {
    /// Name, unique in the rig.
    pub name: String,
    /// Position in the cloud's frame, m.
    #[serde(default)]
    pub position: [f64; 3],
    /// Yaw of the sensor's x axis in the cloud's frame, degrees counter-clockwise from +x.
    #[serde(default)]
    pub yaw_deg: f64,
    /// Pitch, degrees; positive turns the x axis down.
    #[serde(default)]
    pub pitch_deg: f64,
    /// Roll, degrees; positive turns the left side up.
    #[serde(default)]
    pub roll_deg: f64,
    /// Horizontal field of view, symmetric about the sensor's x axis, degrees.
    #[serde(default = "all_around")]
    pub horizontal_fov_deg: f64,
    /// Scan rate, Hz.
    #[serde(default = "twenty")]
    pub rate_hz: f64,
    /// Minimum measured range, m.
    #[serde(default = "half")]
    pub min_range_m: f64,
    /// Maximum measured range, m.
    #[serde(default = "far")]
    pub max_range_m: f64,
    /// Scan pattern; needed for simulation.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pattern: Option<Pattern>,
}

fn all_around() -> f64 {
    360.0
}

fn twenty() -> f64 {
    20.0
}

fn half() -> f64 {
    0.5
}

fn far() -> f64 {
    250.0
}

impl Rig {
    /// Reads a rig. Paths of CSV patterns are relative to its folder.
    pub fn read(path: &Path) -> Result<Rig, DataError> {
        let mut rig: Rig = read_toml(path, Rig::check)?;
        rig.resolve(path)?;
        Ok(rig)
    }

    /// Parses a rig from TOML. `path` is used in error messages, and its folder for CSV patterns.
    pub fn parse(text: &str, path: &Path) -> Result<Rig, DataError> {
        let mut rig: Rig = parse_toml(text, path, Rig::check)?;
        rig.resolve(path)?;
        Ok(rig)
    }

    /// One sensor at the origin with a field of view of 360 degrees: the assumption for a cloud without a rig.
    pub fn single() -> Rig {
        let sensor: Sensor = toml::from_str("name = \"lidar\"").expect("a name is enough");
        Rig { sensors: vec![sensor] }
    }

    fn resolve(&mut self, path: &Path) -> Result<(), DataError> {
        let folder = path.parent().unwrap_or(Path::new(""));
        for sensor in &mut self.sensors {
            let (fov, rate) = (sensor.horizontal_fov_deg, sensor.rate_hz);
            if let Some(pattern) = &mut sensor.pattern {
                pattern.load_shots(folder, fov, rate)?;
            }
        }
        Ok(())
    }

    /// Checks all values. Errors name the key.
    pub fn check(&self) -> Result<(), KeyError> {
        if self.sensors.is_empty() {
            return Err(wrong("sensor", "there is none; a rig has at least one [[sensor]]"));
        }
        if self.sensors.len() > 64 {
            return Err(wrong("sensor", format!("there are {}, more than 64", self.sensors.len())));
        }
        for (i, sensor) in self.sensors.iter().enumerate() {
            let here = format!("sensor[{i}]");
            check_name(&sensor.name).map_err(|message| wrong(format!("{here}.name"), message))?;
            if self.sensors[..i].iter().any(|s| s.name == sensor.name) {
                return Err(wrong(format!("{here}.name"), format!("{:?} is not unique", sensor.name)));
            }
            sensor.check().map_err(|e| e.below(&here))?;
        }
        let shots: f64 = self.sensors.iter().filter_map(|s| s.pattern.as_ref()).map(Pattern::shots_of_grid).sum();
        if shots > MOST_SHOTS {
            let message = format!("all sensors have {shots} shots per scan, more than 16 million");
            return Err(wrong("sensor", message));
        }
        Ok(())
    }

    /// Index of a sensor by name.
    pub fn find(&self, name: &str) -> Option<usize> {
        self.sensors.iter().position(|s| s.name == name)
    }

    /// The rig with the numbers of rows and columns multiplied by `factor`, at least 1 each. CSV patterns do not
    /// change.
    pub fn scaled(mut self, factor: f64) -> Rig {
        for sensor in &mut self.sensors {
            let (fov, rate) = (sensor.horizontal_fov_deg, sensor.rate_hz);
            if let Some(pattern) = &mut sensor.pattern {
                pattern.scale(factor, fov, rate);
            }
        }
        self
    }
}

impl Sensor {
    fn check(&self) -> Result<(), KeyError> {
        for (k, v) in self.position.iter().enumerate() {
            within(&format!("position[{k}]"), *v, -100.0, 100.0)?;
        }
        within("yaw_deg", self.yaw_deg, -360.0, 360.0)?;
        within("pitch_deg", self.pitch_deg, -90.0, 90.0)?;
        within("roll_deg", self.roll_deg, -180.0, 180.0)?;
        within("horizontal_fov_deg", self.horizontal_fov_deg, 0.1, 360.0)?;
        within("rate_hz", self.rate_hz, 0.1, 1000.0)?;
        within("max_range_m", self.max_range_m, 1.0, 5000.0)?;
        within("min_range_m", self.min_range_m, 0.0, self.max_range_m)?;
        self.pattern.as_ref().map_or(Ok(()), |pattern| pattern.check().map_err(|e| e.below("pattern")))
    }

    /// `cloud_from_sensor`: rotation by roll about x, then pitch about y, then yaw about z, then translation.
    pub fn pose(&self) -> Pose {
        let [roll, pitch, yaw] = [self.roll_deg, self.pitch_deg, self.yaw_deg].map(f64::to_radians);
        Isometry3::from_parts(Translation3::from(self.position), UnitQuaternion::from_euler_angles(roll, pitch, yaw))
    }

    /// Half of the horizontal field of view, rad.
    pub fn half_fov_rad(&self) -> f64 {
        (self.horizontal_fov_deg.to_radians() / 2.0).min(PI)
    }

    /// Whether the field of view is a full circle (at least 98 % of it).
    pub fn is_full_circle(&self) -> bool {
        self.half_fov_rad() > 0.98 * PI
    }

    /// Rows that are scanned one after the other, from the top; empty if the scan runs along azimuth, as in spinning
    /// sensors.
    pub fn sequential_rows(&self) -> &[RowBlock] {
        self.pattern.as_ref().filter(|p| p.sweep == Sweep::Rows).map_or(&[], |p| &p.blocks)
    }

    /// Time of a direction within the scan as a fraction: +1/2 at its start, -1/2 at its end. Scans start on the left
    /// or at the top. Angles are in the sensor's frame.
    pub fn scan_phase(&self, azimuth_rad: f64, elevation_rad: f64) -> f64 {
        let blocks = self.sequential_rows();
        let all: f64 = blocks.iter().map(|b| f64::from(b.rows)).sum();
        if all == 0.0 {
            return azimuth_rad / (2.0 * self.half_fov_rad());
        }
        let done = |b: &RowBlock| {
            let rows = f64::from(b.rows);
            let step_deg = ((b.top_deg - b.bottom_deg) / (rows - 1.0).max(1.0)).max(1e-9);
            ((b.top_deg - elevation_rad.to_degrees()) / step_deg + 0.5).clamp(0.0, rows)
        };
        0.5 - blocks.iter().map(done).sum::<f64>() / all
    }

    /// Form of a scan that does not turn evenly, by its phase: what is added to the phase, in units of `uneven`.
    /// Mirrors that swing are fastest in the middle.
    pub fn uneven_phase(phase: f64) -> f64 {
        (std::f64::consts::TAU * phase).sin()
    }

    /// Azimuth (counter-clockwise from x, rad), elevation (rad) and range (m) of a point in the sensor's frame.
    pub fn spherical(sensor_point: &Point3<f64>) -> [f64; 3] {
        let p = sensor_point.coords;
        let across = p.x.hypot(p.y);
        [Self::azimuth_rad(sensor_point), p.z.atan2(across), p.norm()]
    }

    /// Azimuth of a point of the sensor's frame, as in [`Sensor::spherical`].
    pub fn azimuth_rad(sensor_point: &Point3<f64>) -> f64 {
        sensor_point.y.atan2(sensor_point.x)
    }

    /// Whether an azimuth of the sensor's frame is within the horizontal field of view, extended by a margin on both
    /// sides, rad.
    pub fn sees(&self, azimuth_rad: f64, margin_rad: f64) -> bool {
        let half = self.horizontal_fov_deg.to_radians() / 2.0 + margin_rad;
        geometry::limit_period(azimuth_rad, 0.5, std::f64::consts::TAU).abs() <= half
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    fn config(name: &str) -> Rig {
        Rig::read(Path::new(&format!("{}/../../configs/sensors/{name}.toml", env!("CARGO_MANIFEST_DIR")))).unwrap()
    }

    #[test]
    fn the_racing_car_has_three_sensors() {
        let rig = config("av21");
        let yaw: Vec<f64> = rig.sensors.iter().map(|s| s.yaw_deg).collect();
        assert_eq!(yaw, [0.0, 120.0, -120.0]);
        let shots: usize = rig.sensors.iter().map(|s| s.pattern.as_ref().unwrap().shots().len()).sum();
        assert!((78_000..90_000).contains(&shots), "{shots}");
        let left = rig.sensors[1].pose() * Vector3::x();
        assert!((left.x + 0.5).abs() < 1e-9 && left.y > 0.8, "its x axis points left and back: {left}");
        let all = rig.scaled(0.5);
        assert!(
            (all.sensors[0].pattern.as_ref().unwrap().shots().len() as f64 * 12.0 / shots as f64 - 1.0).abs() < 0.05
        );
    }

    #[test]
    fn a_spinning_sensor() {
        let rig = config("hdl64e");
        let shots = rig.sensors[0].pattern.as_ref().unwrap().shots();
        assert_eq!(shots.iter().map(|s| s.row).max(), Some(63));
        let (low, high) =
            shots.iter().fold((f64::MAX, f64::MIN), |(l, h), s| (l.min(s.elevation_rad), h.max(s.elevation_rad)));
        assert!((low.to_degrees() + 24.33).abs() < 0.1 && (high.to_degrees() - 2.0).abs() < 0.1);
    }

    #[test]
    fn patterns_are_optional() {
        let rig = Rig::parse("[[sensor]]\nname = \"a\"\nposition = [1, 0, 2]\n", Path::new("r.toml")).unwrap();
        assert_eq!((rig.sensors[0].horizontal_fov_deg, rig.sensors[0].pattern.as_ref()), (360.0, None));
        assert_eq!(rig.find("a"), Some(0));
    }

    #[test]
    fn scans_run_along_azimuth_or_row_by_row() {
        let sensor = |pattern: &str| {
            let text = format!("[[sensor]]\nname = \"a\"\nhorizontal_fov_deg = 120\n{pattern}");
            Rig::parse(&text, Path::new("rig.toml")).unwrap().sensors.remove(0)
        };
        let spins =
            "pattern = { blocks = [{ rows = 64, top_deg = 6, bottom_deg = -19 }], columns = 9, sweep = \"columns\" }\n";
        for sensor in [sensor(""), sensor(spins)] {
            assert!((sensor.scan_phase(30f64.to_radians(), 0.3) - 0.25).abs() < 1e-12);
        }
        // Three quarters of the rows are above the horizon.
        let blocks =
            "[{ rows = 30, top_deg = 10, bottom_deg = 0.0 }, { rows = 10, top_deg = -0.5, bottom_deg = -20.5 }]";
        let rows = sensor(&format!("pattern = {{ blocks = {blocks}, columns = 400 }}\n"));
        for (elevation_deg, phase) in
            [(12.0, 0.5), (10.0, 0.4875), (5.0, 0.125), (-0.5, -0.2625), (-10.5, -0.375), (-30.0, -0.5)]
        {
            assert!((rows.scan_phase(0.7, f64::to_radians(elevation_deg)) - phase).abs() < 1e-12, "{elevation_deg}");
        }
    }

    #[test]
    fn a_rig_file_needs_only_poses() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rig.toml");
        std::fs::write(&path, "[[sensor]]\nname = \"a\"\nposition = [1, 0, 2.5]\nyaw_deg = 90\n").unwrap();
        let rig = Rig::read(&path).unwrap();
        let at = rig.sensors[0].pose() * Point3::new(2.0, 0.0, 0.0);
        assert!((at - Point3::new(1.0, 2.0, 2.5)).norm() < 1e-12 && rig.sensors[0].is_full_circle());
    }

    #[test]
    fn keys_without_a_unit_are_refused_with_the_right_key() {
        for (line, want) in [
            ("yaw = 3", "unknown field `yaw`: did you mean `yaw_deg`?"),
            ("pitch = 3", "unknown field `pitch`: did you mean `pitch_deg`?"),
            ("roll = 3", "unknown field `roll`: did you mean `roll_deg`?"),
            ("horizontal_fov = 90", "unknown field `horizontal_fov`: did you mean `horizontal_fov_deg`?"),
            ("position_m = [0, 0, 1]", "unknown field `position_m`: did you mean `position`?"),
            ("rate = 10", "unknown field `rate`: did you mean `rate_hz`?"),
            ("max_range = 100", "unknown field `max_range`: did you mean `max_range_m`?"),
        ] {
            let text = format!("[[sensor]]\nname = \"a\"\n{line}\n");
            let error = Rig::parse(&text, Path::new("r.toml")).unwrap_err().to_string();
            assert_eq!(error, format!("r.toml:3: {want}"));
        }
    }

    #[test]
    fn bad_rigs_are_refused_by_line() {
        let pattern = |text: &str| format!("[[sensor]]\nname = \"a\"\n[sensor.pattern]\n{text}\n");
        for (text, want) in [
            ("".to_owned(), "r.toml: sensor: there is none"),
            (
                "[[sensor]]\nname = \"a\"\n[[sensor]]\nname = \"a\"\n".into(),
                "r.toml:4: sensor[1].name: \"a\" is not unique",
            ),
            ("[[sensor]]\nname = \"a\"\ncolour = 1\n".into(), "r.toml:3: unknown field `colour`"),
            (
                "[[sensor]]\nname = \"a\"\nhorizontal_fov_deg = nan\n".into(),
                "r.toml:3: sensor[0].horizontal_fov_deg: NaN",
            ),
            ("[[sensor]]\nname = \"a\"\nmin_range_m = 300\n".into(), "r.toml:3: sensor[0].min_range_m"),
            ("[[sensor]]\nposition = [0, 0, 0]\n".into(), "r.toml:1: missing field `name`"),
            ("[[sensor]]\nname = \"a\"\nposition = [nan, 0, 0]\n".into(), "r.toml:3: sensor[0].position[0]: NaN"),
            ("[[sensor]]\nname = \"a\"\nhorizontal_fov_deg = 0\n".into(), "sensor[0].horizontal_fov_deg: 0"),
            ("[[sensor]]\nname = \"a\"\npattern = \"spiral\"\n".into(), "r.toml:3: sensor[0].pattern: invalid type"),
            (pattern("blocks = []\ncolumns = 10"), "r.toml:4: sensor[0].pattern.blocks: is empty"),
            (
                pattern("blocks = [{ rows = 0, top_deg = 1, bottom_deg = 0 }]\ncolumns = 10"),
                "sensor[0].pattern.blocks[0].rows: 0",
            ),
            (
                pattern("blocks = [{ rows = 2, top_deg = 1, bottom_deg = 5 }]\ncolumns = 10"),
                "blocks[0].bottom_deg: 5 is not between",
            ),
            (
                pattern("blocks = [{ rows = 2, top_deg = 1, bottom_deg = 0 }]\ncolumns = 0"),
                "r.toml:5: sensor[0].pattern.columns: 0",
            ),
            (
                ["a", "b"]
                    .map(|name| {
                        let blocks = "[{ rows = 4000, top_deg = 1, bottom_deg = 0 }]";
                        format!("[[sensor]]\nname = \"{name}\"\npattern = {{ blocks = {blocks}, columns = 3000 }}\n")
                    })
                    .concat(),
                "all sensors have 24000000 shots",
            ),
            (pattern("file = \"none.csv\""), "none.csv"),
        ] {
            let error = Rig::parse(&text, Path::new("r.toml")).unwrap_err().to_string();
            assert!(error.contains(want), "{text}: {error}");
        }
    }
}
