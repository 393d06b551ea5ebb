//! Angles that close.

use std::f64::consts::{PI, TAU};

/// `angle` moved into [-pi, pi).
pub(crate) fn wrapped(angle: f64) -> f64 {
    (angle + PI).rem_euclid(TAU) - PI
}
