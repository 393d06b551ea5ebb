//! The shots of a scan before they are sent: where they really go, which need not be where the sensor believes.

use crate::rig::{Rig, Shot};
use geometry::Pose;
use nalgebra::{UnitQuaternion, Vector3};
use std::sync::Arc;

/// All shots of one scan.
#[derive(Clone, Debug)]
pub struct Beams {
    /// A sensor each, in the order of the rig.
    pub sensors: Vec<SensorBeams>,
    /// How the car really stands, against how it is believed to stand: `believed_from_true` turned about the car's origin.
    pub ego_tilt: UnitQuaternion<f64>,
    /// How much higher the car really is, m, along its own z.
    pub ego_heave_m: f64,
    /// Shots are sent one after the other while everything moves; otherwise all at once.
    pub shutter: Option<Shutter>,
    /// Beams have a width; otherwise they are lines.
    pub width: Option<BeamWidth>,
}

/// The shots of one sensor.
#[derive(Clone, Debug)]
pub struct SensorBeams {
    /// `cloud_from_sensor` as the rig says.
    pub believed_mount: Pose,
    /// `cloud_from_sensor` as it is.
    pub true_mount: Pose,
    /// The pattern.
    pub shots: Arc<[Shot]>,
    /// Columns of the pattern as a grid.
    pub columns: usize,
    /// Directions of the pattern, sensor's frame, unit vectors.
    pub believed: Arc<[[f32; 3]]>,
    /// Directions in which the shots really go; the pattern's when empty.
    pub true_directions: Vec<[f32; 3]>,
    /// Nearest and farthest measured range, m.
    pub limits_m: [f32; 2],
}

/// How a scan that takes time is put together.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shutter {
    /// Points are moved to where they would be seen from at the middle of the scan, by the car's own motion.
    pub deskewed: bool,
}

/// A beam as a bundle of rays.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BeamWidth {
    /// Full angle within which the bundle lies, rad.
    pub divergence_rad: f32,
    /// Rays of a bundle: 7 or 19.
    pub rays: usize,
    /// Surfaces that are less than this apart along the beam make one return, m.
    pub pulse_m: f32,
    /// Which return counts.
    pub pick: Pick,
    /// Report a second return too.
    pub second: bool,
}

/// Which of several returns of a beam is reported.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Pick {
    /// The one with the most light.
    #[default]
    Strongest,
    /// The nearest.
    First,
    /// The farthest.
    Last,
}

impl SensorBeams {
    /// The directions in which the shots really go, to be changed.
    pub fn true_directions_mut(&mut self) -> &mut Vec<[f32; 3]> {
        if self.true_directions.is_empty() {
            self.true_directions = self.believed.to_vec();
        }
        &mut self.true_directions
    }

    /// The directions in which the shots really go.
    pub fn directions(&self) -> &[[f32; 3]] {
        if self.true_directions.is_empty() { &self.believed } else { &self.true_directions }
    }
}

impl Beams {
    /// The shots of a rig as its patterns say; sensors without a pattern have none.
    pub fn of(rig: &Rig) -> Beams {
        let sensor = |sensor: &crate::Sensor| {
            let shots: Arc<[Shot]> = sensor.pattern.as_ref().map_or(&[][..], |p| p.shots()).into();
            SensorBeams {
                believed_mount: sensor.pose(),
                true_mount: sensor.pose(),
                columns: sensor.pattern.as_ref().map_or(1, |p| p.grid_columns().max(1)),
                believed: shots.iter().map(|s| s.direction().map(|v| v as f32)).collect(),
                shots,
                true_directions: Vec::new(),
                limits_m: [sensor.min_range_m as f32, sensor.max_range_m as f32],
            }
        };
        Beams {
            sensors: rig.sensors.iter().map(sensor).collect(),
            ego_tilt: UnitQuaternion::identity(),
            ego_heave_m: 0.0,
            shutter: None,
            width: None,
        }
    }

    /// Number of shots.
    pub fn shots(&self) -> usize {
        self.sensors.iter().map(|s| s.shots.len()).sum()
    }
}

/// Turns a unit vector by small angles: to the left about the vertical, and up, rad.
pub fn turned(direction: [f32; 3], left_rad: f32, up_rad: f32) -> [f32; 3] {
    let [x, y, z] = direction;
    let flat = x.hypot(y).max(1e-6);
    let d = Vector3::new(x, y, z);
    let left = Vector3::new(-y / flat, x / flat, 0.0);
    let up = Vector3::new(-z * x / flat, -z * y / flat, flat);
    (d + left * (left_rad * flat) + up * up_rad).normalize().into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_turns() {
        for direction in [[1.0, 0.0, 0.0], [0.6, 0.0, -0.8], [-0.48, 0.64, 0.6]] {
            let [x, y, z]: [f32; 3] = direction;
            let (azimuth, elevation) = (y.atan2(x), z.asin());
            let got = turned(direction, 0.002, -0.001);
            assert!((got[1].atan2(got[0]) - azimuth - 0.002).abs() < 1e-5);
            assert!((got[2].asin() - elevation + 0.001).abs() < 1e-5);
        }
    }
}
