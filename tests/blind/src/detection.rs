//! Losses of returns by hidden effects.

use crate::effect::Effect;
use crate::rig::Mount;
use crate::solid::{Hit, Material};

/// A shot that met a surface.
pub struct Incidence<'a> {
    /// Where it met it.
    pub hit: &'a Hit,
    /// Cosine of the angle of incidence.
    pub cos: f64,
    /// Number of the sensor.
    pub sensor: usize,
    /// Azimuth and elevation as reported, rad.
    pub angles: [f64; 2],
    /// The sensor.
    pub mount: &'a Mount,
}

impl Effect {
    /// Share of the returns that the effect keeps; 1 for a signal dropout, which depends on a random number.
    pub fn kept(&self, at: &Incidence) -> f64 {
        let (range, c, [az, el], mount) = (at.hit.range_m, at.cos, at.angles, at.mount);
        match self {
            Effect::RandomDropout { share } => 1.0 - share,
            Effect::RangeDropout { half_at_m, softness_m } => {
                0.5 - (range - half_at_m) / (2.0 * (softness_m.powi(2) + (range - half_at_m).powi(2)).sqrt())
            }
            Effect::IncidenceDropout { half_at_cos, power } => {
                let u = (c / half_at_cos).powf(*power);
                u / (1.0 + u)
            }
            Effect::MaterialDropout { tyres, share } => {
                let material = if *tyres { Material::Rubber } else { Material::Paint };
                if at.hit.material == material { 1.0 - share } else { 1.0 }
            }
            Effect::RangeCut { max_m } => f64::from(u8::from(range <= *max_m)),
            Effect::StripedLoss { share, stripes } => {
                let u = (el - mount.rows_rad[mount.rows_rad.len() - 1])
                    / (mount.rows_rad[0] - mount.rows_rad[mount.rows_rad.len() - 1]);
                1.0 - share * (1.0 + (std::f64::consts::TAU * stripes * u).sin()) / 2.0
            }
            Effect::Smear { share, middle, half_rad } if at.sensor == 0 => {
                let (high, low) = (mount.rows_rad[0], mount.rows_rad[mount.rows_rad.len() - 1]);
                let off = [az - middle[0] * mount.fov_rad, el - (low + middle[1] * (high - low))];
                let from_middle = (off[0] / half_rad[0]).hypot(off[1] / half_rad[1]);
                1.0 - share * ((1.25 - from_middle) / 0.5).clamp(0.0, 1.0)
            }
            _ => 1.0,
        }
    }
}
