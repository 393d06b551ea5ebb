//! Returns where the simulation has none: alone, in groups, between the two surfaces of an edge. Simulated returns are counted alike, each
//! against the others, so that what both sides have cancels.

use crate::pairing::{FramePair, Lies, Ray, Surface};
use rayon::prelude::*;

/// Kinds of returns that stand out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Odd {
    /// Alone, in front of the surface, behind it or in the open; not at an edge.
    Alone,
    /// Between the two surfaces of an edge.
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

/// Jumps in range that mix, m.
const JUMP_M: [f64; 2] = [1.2, 12.0];

/// What a return is, if it stands out.
pub fn odd(ray: &Ray) -> Option<Odd> {
    let lies = ray.lies();
    if ray.own_range_m() < OWN_CAR_M {
        return None;
    }
    match lies {
        Lies::On => None,
        Lies::Between => {
            let jump = f64::from(ray.near_far_m[1] - ray.near_far_m[0]);
            (JUMP_M[0]..JUMP_M[1]).contains(&jump).then_some(Odd::Between)
        }
        _ if ray.company <= 1 => (ray.smooth || lies == Lies::Open).then_some(Odd::Alone),
        _ if ray.company < 4 || ray.surface == Surface::Object => None,
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
    /// Simulated returns at an edge of a jump that mixes.
    pub at_edges: f64,
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
                    let jump = f64::from(ray.near_far_m[1] - ray.near_far_m[0]);
                    if side == 1 && !ray.smooth && (JUMP_M[0]..JUMP_M[1]).contains(&jump) {
                        out.at_edges += 1.0;
                    }
                }
            }
            out
        })
        .collect()
}
