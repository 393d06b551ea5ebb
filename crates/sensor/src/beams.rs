//! Directions and poses of the shots of a scan before ray casting. The true values can differ from those that the
//! sensor reports.

use crate::rig::{Rig, Shot};
use geometry::Pose;
use nalgebra::{UnitQuaternion, Vector3};
use std::sync::Arc;

/// All shots of one scan.
#[derive(Clone, Debug)]
pub struct Beams {
    /// One entry per sensor, in the order of the rig.
    pub sensors: Vec<SensorBeams>,
    /// Attitude error of the ego vehicle: rotation `nominal_from_true` about the origin of the cloud's frame.
    pub ego_tilt: UnitQuaternion<f64>,
    /// Height of the ego vehicle above its reported pose, along its z axis, m.
    pub ego_heave_m: f64,
    /// Shots are sent one after the other while everything moves; `None`: all at the same time.
    pub shutter: Option<Shutter>,
    /// Divergence of the beams; `None`: each is a single ray.
    pub width: Option<BeamWidth>,
}

/// The shots of one sensor.
#[derive(Clone, Debug)]
pub struct SensorBeams {
    /// `cloud_from_sensor` of the rig.
    pub nominal_mount: Pose,
    /// True `cloud_from_sensor`.
    pub true_mount: Pose,
    /// Shots of the pattern.
    pub shots: Arc<[Shot]>,
    /// Number of columns of the pattern as a grid.
    pub columns: usize,
    /// Directions of the pattern, unit vectors in the sensor's frame.
    pub nominal_directions: Arc<[[f32; 3]]>,
    /// True directions, unit vectors in the sensor's frame; empty if they are those of the pattern.
    pub true_directions: Vec<[f32; 3]>,
    /// Minimum and maximum measured range, m.
    pub limits_m: [f32; 2],
}

/// Motion during a scan.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shutter {
    /// Points are corrected for ego motion to the middle of the scan.
    pub deskewed: bool,
}

/// A divergent beam as a bundle of rays.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BeamWidth {
    /// Full divergence angle, rad.
    pub divergence_rad: f32,
    /// Number of rays: 7 or 19.
    pub rays: usize,
    /// Range separation below which surfaces give one return, m.
    pub pulse_m: f32,
    /// Which of several returns is reported.
    pub pick: Pick,
    /// Also report a second return.
    pub second: bool,
}

/// Which of several returns of a beam is reported.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Pick {
    /// The one with the most returned light.
    #[default]
    Strongest,
    /// The nearest.
    First,
    /// The farthest.
    Last,
}

impl SensorBeams {
    /// True directions of the shots, to be changed.
    pub fn true_directions_mut(&mut self) -> &mut Vec<[f32; 3]> {
        if self.true_directions.is_empty() {
            self.true_directions = self.nominal_directions.to_vec();
        }
        &mut self.true_directions
    }

    /// True directions of the shots.
    pub fn directions(&self) -> &[[f32; 3]] {
        if self.true_directions.is_empty() { &self.nominal_directions } else { &self.true_directions }
    }
}

impl Beams {
    /// Nominal shots of a rig. Sensors without a pattern have none.
    pub fn of(rig: &Rig) -> Beams {
        let sensor = |sensor: &crate::Sensor| {
            let shots: Arc<[Shot]> = sensor.pattern.as_ref().map_or(&[][..], |p| p.shots()).into();
            SensorBeams {
                nominal_mount: sensor.pose(),
                true_mount: sensor.pose(),
                columns: sensor.pattern.as_ref().map_or(1, |p| p.grid_columns().max(1)),
                nominal_directions: shots.iter().map(|s| s.direction().map(|v| v as f32)).collect(),
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

    /// Total number of shots.
    pub fn shots(&self) -> usize {
        self.sensors.iter().map(|s| s.shots.len()).sum()
    }
}

/// Rotates a unit vector by small angles, rad: `left_rad` about the vertical axis, `up_rad` upwards.
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
