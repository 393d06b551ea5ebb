//! LiDAR sensors, whoever made the data: where they are mounted and what they see ([`rig`]), what came back of a scan
//! ([`scan`]), which sensor a point belongs to ([`assignment`]), how strong a return is ([`signal`]), and the sensor
//! model as a list of [`effects`].
//!
//! Nothing here casts a ray. An effect that has to ask what another ray would meet asks a [`RayCaster`], which a
//! simulator provides.

pub mod assignment;
pub mod attributes;
pub mod beams;
pub mod car;
pub mod cloud_scan;
pub mod effects;
pub mod matched;
pub mod material;
pub mod object;
mod ray_caster;
pub mod rig;
pub mod scan;
pub mod signal;

pub use effects::{Effect, EffectList};
pub use ray_caster::{RayCaster, Surface};
pub use rig::{Rig, Sensor};
