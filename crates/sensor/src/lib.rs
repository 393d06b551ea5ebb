//! LiDAR sensors, independent of any simulator: sensor rigs ([`rig`]), the echoes of a scan ([`scan`]), assignment of
//! points to sensors ([`assignment`]), the signal index ([`signal`]), and the sensor model as a list of [`effects`].
//!
//! This crate casts no rays. Effects that need additional rays use a [`RayCaster`], which a simulator provides.

pub mod assignment;
pub mod attributes;
pub mod beams;
pub mod car;
pub mod cloud_scan;
pub mod clouds;
pub mod directions;
pub mod effects;
pub mod finished;
pub mod matched;
pub mod material;
pub mod motion;
pub mod object;
mod ray_caster;
pub mod rig;
pub mod scan;
pub mod signal;

pub use effects::{Effect, EffectList};
pub use ray_caster::{RayCaster, Surface};
pub use rig::{Rig, Sensor};
