//! Returns without a surface at their place: false alarms, weather, halos, ghosts.

use crate::effect::Effect;
use crate::frame::{Echo, Frame};
use crate::sensor::Shot;
use crate::solid::Material;
use crate::world::REACH_M;
use data::Stream;
use rand::RngExt;
use std::f64::consts::TAU;

/// Smallest range that a sensor reports, m.
pub const NEAREST_M: f64 = 0.6;

/// A way in which a shot may return from elsewhere.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Clutter {
    /// Probability for this shot.
    pub rate: f64,
    /// Where it returns from.
    pub law: Law,
}

/// Ranges of returns without a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Law {
    /// Uniform up to a range, m.
    Uniform(f64),
    /// Denser near the sensor: up to a range (m), as a power of a uniform number.
    Power(f64, f64),
    /// From drops between two ranges, m; their density falls as 1 / r.
    Drops(f64, f64),
    /// Backscatter: a gamma law with this mean, m.
    Backscatter(f64),
    /// Between two ranges, m.
    Between(f64, f64),
    /// In the air between two ranges, m.
    Plume(f64, f64),
    /// At a range, m.
    At(f64),
}

impl Law {
    /// A random range, m.
    pub fn draw(&self, rng: &mut Stream) -> f64 {
        let u: f64 = rng.random();
        match *self {
            Law::Uniform(reach) => NEAREST_M + (reach - NEAREST_M) * u,
            Law::Power(reach, power) => NEAREST_M + (reach - NEAREST_M) * u.powf(power),
            Law::Drops(low, high) => low * (high / low).powf(u),
            Law::Backscatter(mean) => {
                let v: f64 = rng.random();
                -0.5 * mean * ((1.0 - u) * (1.0 - v)).max(1e-12).ln()
            }
            Law::Between(low, high) | Law::Plume(low, high) => low + (high - low) * u,
            Law::At(range) => range + 0.05 * (u - 0.5),
        }
    }

    /// Whether the returns come from droplets in the air.
    pub fn is_of_droplets(&self) -> bool {
        matches!(self, Law::Drops(..) | Law::Backscatter(_) | Law::Plume(..))
    }

    /// Length of the ranges that hold most of the returns, m: how far they are from being spread over all ranges.
    pub fn extent_m(&self) -> f64 {
        match *self {
            Law::Uniform(reach) => reach,
            Law::Power(reach, power) => reach / power.max(1.0),
            Law::Drops(_, high) => 0.3 * high,
            Law::Backscatter(mean) => 2.0 * mean,
            Law::Between(low, high) | Law::Plume(low, high) => (high - low).max(0.2),
            Law::At(_) => 0.2,
        }
    }
}

impl Frame<'_> {
    /// Returns from elsewhere that are present on both sides.
    pub fn usual_clutter(&self) -> Clutter {
        Clutter { rate: self.side.nuisances.false_returns * self.unsteady()[4].exp(), law: Law::Uniform(REACH_M) }
    }

    /// Ways in which the effects return a shot from elsewhere.
    pub fn clutter(&self, shot: &Shot, echo: Option<&Echo>) -> Vec<Clutter> {
        let mut ways = Vec::new();
        let free_m = echo.map_or(REACH_M, |e| e.range_m);
        for effect in &self.side.effects {
            let way = match *effect {
                Effect::Outliers { share, reach_m } => Some(Clutter { rate: share, law: Law::Power(reach_m, 1.15) }),
                Effect::Rain { drops, .. } => Some(Clutter { rate: drops, law: Law::Drops(0.8, 22.0) }),
                Effect::Fog { visibility_m, backscatter } => {
                    Some(Clutter { rate: backscatter, law: Law::Backscatter(0.06 * visibility_m) })
                }
                Effect::Spray { per_m } => self.plume_m(shot, free_m).map(|(_, [begin, end], times)| Clutter {
                    rate: 1.0 - (-per_m * times * (end - begin)).exp(),
                    law: Law::Plume(begin, end),
                }),
                Effect::Interference { share, stripes } => {
                    let oblique = stripes * shot.azimuth_rad + 3.0 * stripes * shot.elevation_rad + self.stripes;
                    let range = 15.0 + 12.0 * (2.0 * oblique / TAU).rem_euclid(1.0);
                    (oblique.sin() > 0.9).then_some(Clutter { rate: share, law: Law::Between(range, range + 2.0) })
                }
                Effect::Ghosts { probability } => echo
                    .filter(|e| matches!(e.material, Material::Glass | Material::Paint))
                    .and_then(|e| Some(e.range_m + self.mirrored_m(shot, e)?))
                    .filter(|range| *range < REACH_M)
                    .map(|range| Clutter { rate: probability, law: Law::At(range) }),
                Effect::Blooming { strength, halo_rad } => {
                    let brights = self.bright[shot.sensor].iter().filter(|b| b.range_m + 0.5 < free_m);
                    let halo = brights.map(|b| {
                        let off = (self.away(shot, &b.direction) - b.half_rad).max(0.0);
                        (strength * (-off / halo_rad).exp(), b.range_m)
                    });
                    let most = halo.max_by(|a, b| a.0.total_cmp(&b.0)).filter(|(rate, _)| *rate > 1e-3);
                    most.map(|(rate, range)| Clutter { rate, law: Law::At(range) })
                }
                _ => None,
            };
            ways.extend(way);
        }
        ways
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_follow_their_law() {
        let mut rng = data::stream(1, "clutter", 0, 0);
        for (law, low, high, mean) in [
            (Law::Uniform(100.0), 0.6, 100.0, 50.3),
            (Law::Power(100.0, 2.0), 0.6, 100.0, 33.7),
            (Law::Drops(1.0, 20.0), 1.0, 20.0, 19.0 / 20f64.ln()),
            (Law::Backscatter(10.0), 0.0, 200.0, 10.0),
            (Law::Between(3.0, 5.0), 3.0, 5.0, 4.0),
            (Law::At(30.0), 29.9, 30.1, 30.0),
        ] {
            let drawn: Vec<f64> = (0..20_000).map(|_| law.draw(&mut rng)).collect();
            assert!(drawn.iter().all(|r| (low..=high).contains(r)), "{law:?}");
            let found = drawn.iter().sum::<f64>() / drawn.len() as f64;
            assert!((found / mean - 1.0).abs() < 0.03, "{law:?}: {found}");
        }
    }
}
