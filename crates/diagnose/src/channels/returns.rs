//! Returns off the simulated surfaces: lone ones and groups. Simulated returns are counted in the same way, each
//! against the others, so that effects of both sides cancel.

use crate::pairing::{FramePair, Lies, Ray, Surface, company_m};
use rayon::prelude::*;

/// Kinds of returns off the surfaces.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Odd {
    /// Lone, in front of the surface, behind it or without one; not at an edge. None of its own side is beside it: a
    /// simulated return with another one beside it would not lie off a surface, and where both sides have many of them
    /// pairs would remain.
    Alone,
    /// Grouped, in front of the surface or without one; not on labelled objects nor so near that they belong to one.
    GroupInFront,
    /// Grouped, behind the surface; neither on labelled objects nor beside them.
    GroupBehind,
}

/// All kinds.
pub const ODD: [Odd; 3] = [Odd::Alone, Odd::GroupInFront, Odd::GroupBehind];

/// Distance from a surface within which a return lies on it, m: along the ray, or across the surface.
const ON_M: [f64; 2] = [0.6, 0.3];

/// Nearest range of lone returns, m: nearer ones are from the sensor's housing.
pub const NEAREST_M: f64 = 1.0;

/// Range below which a return may be from the ego vehicle, m: only single ones in front of surfaces count.
pub const OWN_CAR_M: f64 = 4.0;

/// Neighbours at the same range from which on returns are grouped. Mixed ranges may have a few: a beam wider than the
/// steps mixes several neighbouring shots alike.
pub const FEW: u8 = 4;

/// The kind of a return; `None` on a surface.
pub fn odd(ray: &Ray) -> Option<Odd> {
    let lies = ray.lies();
    if ray.own_range_m() < OWN_CAR_M {
        let single = ray.own_range_m() >= NEAREST_M && is_lone_before(ray);
        return single.then_some(Odd::Alone);
    }
    match lies {
        Lies::On => None,
        // Without rows nothing says that the simulation sent a shot there.
        Lies::Open if ray.row == u16::MAX => None,
        // What both sides show is lone on neither.
        _ if ray.company == 0 => (!ray.shown && (ray.smooth || lies == Lies::Open)).then_some(Odd::Alone),
        _ if ray.company < FEW || ray.surface == Surface::Object || ray.at_object => None,
        Lies::Behind => Some(Odd::GroupBehind),
        _ => Some(Odd::GroupInFront),
    }
}

/// Range up to which a shot towards a smooth surface is free, m: nearer than all that the simulation has around its
/// direction.
pub fn free_until_m(ray: &Ray) -> f64 {
    f64::from(ray.range_m.min(ray.near_far_m[0])) - margin_m(ray)
}

/// Distance in front of the predicted surface of a ray within which returns cannot be distinguished from it, m.
pub fn margin_m(ray: &Ray) -> f64 {
    (ON_M[1] / f64::from(ray.cos_incidence).max(1e-3)).max(ON_M[0]).max(company_m(ray.range_m.into()))
}

/// Whether a return is alone on the free path of its shot, or where the simulation has nothing.
pub fn is_lone_before(ray: &Ray) -> bool {
    let before = match ray.lies() {
        Lies::InFront => ray.smooth && ray.own_range_m() < free_until_m(ray),
        Lies::Open => ray.row != u16::MAX,
        _ => false,
    };
    before && !ray.shown && ray.company == 0
}

/// Counts of one frame: measured and simulated returns of each kind, and all of them.
#[derive(Clone, Copy, Debug, Default)]
pub struct OddFrame {
    /// By kind: measured, simulated.
    pub counts: [[f64; 2]; 3],
    /// All returns: measured, simulated.
    pub all: [f64; 2],
}

/// Largest range of the simulation, m: one in 2000 returns lies farther. Beyond it the measured side cannot be judged.
pub fn end_m(frames: &[FramePair]) -> f64 {
    let mut ranges: Vec<f64> =
        frames.iter().flat_map(|f| f.simulated.iter().step_by(7)).map(Ray::own_range_m).collect();
    ranges.sort_by(f64::total_cmp);
    let last = ranges.len().saturating_sub(1 + ranges.len() / 2000);
    ranges.get(last).copied().unwrap_or(f64::INFINITY)
}

/// Counts of every frame, of returns nearer than `end_m`. `explained` says which returns do not count, by the number of
/// the frame, side (0 measured) and their place there.
pub fn odd_frames(
    frames: &[FramePair],
    end_m: f64,
    explained: &(dyn Fn(usize, usize, usize) -> bool + Sync),
) -> Vec<OddFrame> {
    frames
        .par_iter()
        .enumerate()
        .map(|(number, frame)| {
            let mut out =
                OddFrame { all: [frame.measured.len() as f64, frame.simulated.len() as f64], ..OddFrame::default() };
            for (side, rays) in [&frame.measured, &frame.simulated].into_iter().enumerate() {
                for (i, ray) in rays.iter().enumerate().filter(|(_, r)| r.own_range_m() < end_m) {
                    if let Some(kind) = odd(ray).filter(|_| !explained(number, side, i)) {
                        out.counts[kind as usize][side] += 1.0;
                    }
                }
            }
            out
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    #[test]
    fn a_group_beside_a_labelled_object_is_a_part_of_it() {
        let before = Ray { residual_m: -3.0, ..Ray::standing(&Vector3::new(20.0, 0.0, 0.0)) };
        assert_eq!(odd(&before), Some(Odd::GroupInFront));
        assert_eq!(odd(&Ray { residual_m: 3.0, ..before }), Some(Odd::GroupBehind));
        assert_eq!(odd(&Ray { at_object: true, ..before }), None);
        assert_eq!(odd(&Ray { residual_m: 3.0, at_object: true, ..before }), None);
        assert_eq!(odd(&Ray { company: 0, at_object: true, ..before }), Some(Odd::Alone));
    }
}
