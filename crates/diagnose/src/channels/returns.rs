//! Returns where the simulation has none: alone, in groups, in the gap between the two surfaces of an edge. Simulated returns are counted
//! alike, each against the others, and in gaps of the measured side, so that what both sides have cancels.

use crate::pairing::{FramePair, Lies, Ray, Surface};
use rayon::prelude::*;

/// Kinds of returns that stand out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Odd {
    /// Alone, in front of the surface, behind it or in the open; not at an edge.
    Alone,
    /// In a gap of the other side, between the two surfaces of an edge.
    Between,
    /// In company, in front of the surface or in the open; not on objects.
    GroupInFront,
    /// In company, behind the surface; not on objects.
    GroupBehind,
}

/// All kinds.
pub const ODD: [Odd; 4] = [Odd::Alone, Odd::Between, Odd::GroupInFront, Odd::GroupBehind];

/// Nearer than that it may be the own car, m.
pub const OWN_CAR_M: f64 = 4.0;

/// In the middle of a jump there may be a few in company: a beam wider than the steps mixes several shots beside each other alike.
const FEW: u8 = 4;

/// Nearer to a smooth surface than that, across it, a return lies on it, m.
const FLAT_M: f64 = 0.15;

/// What a return is, if it stands out.
pub fn odd(ray: &Ray) -> Option<Odd> {
    let lies = ray.lies();
    if ray.own_range_m() < OWN_CAR_M {
        return None;
    }
    match lies {
        // On a smooth surface met at a grazing angle neighbouring rows lie apart as well.
        _ if ray.in_gap && ray.company < FEW && !(ray.smooth && ray.across_m().abs() < FLAT_M) => Some(Odd::Between),
        Lies::On => None,
        _ if ray.company <= 1 => (ray.smooth || lies == Lies::Open).then_some(Odd::Alone),
        _ if ray.company < FEW || ray.surface == Surface::Object => None,
        Lies::Behind => Some(Odd::GroupBehind),
        _ => Some(Odd::GroupInFront),
    }
}

/// Counts of one frame: measured and simulated returns of each kind, and all of them.
#[derive(Clone, Copy, Debug, Default)]
pub struct OddFrame {
    /// By kind: measured, simulated.
    pub counts: [[f64; 2]; 4],
    /// All returns: measured, simulated.
    pub all: [f64; 2],
    /// Returns that beams would mix over the jumps of the simulated side, for each radian of their width.
    pub mixed_per_rad: f64,
}

/// Where the simulation ends, m: but for a few, no return lies farther. Beyond it the measured side cannot be judged.
pub fn end_m(frames: &[FramePair]) -> f64 {
    let mut ranges: Vec<f64> =
        frames.iter().flat_map(|f| f.simulated.iter().step_by(7)).map(Ray::own_range_m).collect();
    ranges.sort_by(f64::total_cmp);
    let last = ranges.len().saturating_sub(1 + ranges.len() / 2000);
    ranges.get(last).copied().unwrap_or(f64::INFINITY)
}

/// Counts of every frame, of returns nearer than `end_m`. The two sides may have been thinned differently: simulated counts are scaled to the measured share.
pub fn odd_frames(frames: &[FramePair], end_m: f64) -> Vec<OddFrame> {
    frames
        .par_iter()
        .map(|frame| {
            let mut out =
                OddFrame { all: [frame.measured.len() as f64, frame.simulated.len() as f64], ..OddFrame::default() };
            for (side, rays) in [&frame.measured, &frame.simulated].into_iter().enumerate() {
                for ray in rays.iter().filter(|r| r.own_range_m() < end_m) {
                    if let Some(kind) = odd(ray) {
                        out.counts[kind as usize][side] += 1.0;
                    }
                }
            }
            out.mixed_per_rad = frame.mixed_per_rad * out.all[1];
            out
        })
        .collect()
}
