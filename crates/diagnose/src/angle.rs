//! The sensors, and angles that close.

pub use sensor::{Rig as SensorRig, Sensor as SensorMount};
use std::f64::consts::{PI, TAU};

/// `angle` moved into [-pi, pi).
pub fn wrapped(angle: f64) -> f64 {
    (angle + PI).rem_euclid(TAU) - PI
}
