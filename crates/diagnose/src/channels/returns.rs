//! Returns off the simulated surfaces: lone ones, groups, and returns between the two surfaces of an edge. Simulated
//! returns are counted in the same way, each against the others and in gaps of the measured side, so that effects of
//! both sides cancel.

use crate::pairing::{FramePair, Lies, Ray, Surface};
use rayon::prelude::*;

/// Kinds of returns off the surfaces.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Odd {
    /// Lone, in front of the surface, behind it or without one; not at an edge.
    Alone,
    /// In a gap of the other side, between the two surfaces of an edge.
    Between,
    /// Grouped, in front of the surface or without one; not on objects.
    GroupInFront,
    /// Grouped, behind the surface; not on objects.
    GroupBehind,
}

/// All kinds.
pub const ODD: [Odd; 4] = [Odd::Alone, Odd::Between, Odd::GroupInFront, Odd::GroupBehind];

/// Range below which a return may be from the ego vehicle, m.
pub const OWN_CAR_M: f64 = 4.0;

/// Neighbours at the same range from which on returns are grouped. Mixed ranges may have a few: a beam wider than the
/// steps mixes several neighbouring shots alike.
const FEW: u8 = 4;

/// Distance from a smooth surface, across it, within which a return lies on it, m.
const FLAT_M: f64 = 0.15;

/// The kind of a return; `None` on a surface.
pub fn odd(ray: &Ray) -> Option<Odd> {
    let lies = ray.lies();
    if ray.own_range_m() < OWN_CAR_M {
        return None;
    }
    match lies {
        // On a smooth surface at grazing incidence neighbouring rows lie apart as well.
        _ if ray.in_gap && ray.company < FEW && !(ray.smooth && ray.across_m().abs() < FLAT_M) => Some(Odd::Between),
        Lies::On => None,
        // Without rows nothing says that the simulation sent a shot there.
        Lies::Open if ray.row == u16::MAX => None,
        _ if ray.company <= 1 => (ray.smooth || lies == Lies::Open).then_some(Odd::Alone),
        _ if ray.company < FEW || ray.surface == Surface::Object => None,
        Lies::Behind => Some(Odd::GroupBehind),
        _ => Some(Odd::GroupInFront),
    }
}

/// Counts of one frame: measured and simulated returns of each kind, and all of them.
#[derive(Clone, Copy, Debug, Default)]
pub struct OddFrame {
    /// By kind: measured, simulated. Returns between the surfaces of an edge are for as many edges as the simulation
    /// has.
    pub counts: [[f64; 2]; 4],
    /// All returns: measured, simulated.
    pub all: [f64; 2],
    /// Returns that beams would mix over the jumps of the simulated side, for each radian of their width.
    pub mixed_per_rad: f64,
}

/// Largest range of the simulation, m: one in 2000 returns lies farther. Beyond it the measured side cannot be judged.
pub fn end_m(frames: &[FramePair]) -> f64 {
    let mut ranges: Vec<f64> =
        frames.iter().flat_map(|f| f.simulated.iter().step_by(7)).map(Ray::own_range_m).collect();
    ranges.sort_by(f64::total_cmp);
    let last = ranges.len().saturating_sub(1 + ranges.len() / 2000);
    ranges.get(last).copied().unwrap_or(f64::INFINITY)
}

/// Counts of every frame, of returns nearer than `end_m`.
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
            // Where the scenes differ, there are as many ranges between edges as there are edges.
            out.counts[Odd::Between as usize][0] /= frame.jumps;
            out.mixed_per_rad = frame.mixed_per_rad * out.all[1];
            out
        })
        .collect()
}
