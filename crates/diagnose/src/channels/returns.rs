//! Returns where the simulation has none: alone, in groups, between the two surfaces of an edge. Simulated returns are counted alike, each
//! against the others, so that what both sides have cancels.

use crate::inference::median;
use crate::pairing::{FramePair, Lies, Ray, Surface, gap_margin_m, gap_mixes};
use rayon::prelude::*;
use std::collections::BTreeMap;

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

/// In the middle of a jump there may be a few in company: a beam wider than the steps mixes several shots beside each other alike.
const FEW: u8 = 4;

/// What a return is, if it stands out.
pub fn odd(ray: &Ray) -> Option<Odd> {
    let lies = ray.lies();
    if ray.own_range_m() < OWN_CAR_M {
        return None;
    }
    match lies {
        _ if ray.in_gap && ray.company < FEW => Some(Odd::Between),
        Lies::On | Lies::Between => None,
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
            out.mixed_per_rad = mixed_per_rad(&frame.simulated);
            out
        })
        .collect()
}

/// How many returns a beam would mix over the jumps of a scan, for each radian of its width: an edge between two neighbours that are an angle apart is
/// met by as large a share of the shots as the beam is wide against that angle. 0 where rows are not known.
fn mixed_per_rad(rays: &[Ray]) -> f64 {
    let mut rows = BTreeMap::<(u8, u16), Vec<&Ray>>::new();
    for ray in rays.iter().filter(|r| r.row != u16::MAX) {
        rows.entry((ray.sensor, ray.row)).or_default().push(ray);
    }
    rows.values_mut().for_each(|row| row.sort_by(|a, b| a.azimuth_rad.total_cmp(&b.azimuth_rad)));
    let of_pair = |a: &Ray, b: &Ray, apart_rad: f64| {
        let mixes = if a.smooth || b.smooth { 0.0 } else { mixing_share(a.own_range_m(), b.own_range_m()) };
        mixes / apart_rad.max(1e-5)
    };
    let mut sum = 0.0;
    for (&(sensor, number), row) in &rows {
        let gaps = row.windows(2).map(|w| f64::from(w[1].azimuth_rad - w[0].azimuth_rad));
        let step = median(gaps.clone().collect());
        for (pair, gap) in row.windows(2).zip(gaps).filter(|(_, gap)| *gap < 1.7 * step) {
            sum += of_pair(pair[0], pair[1], gap * f64::from(pair[0].elevation_rad).cos());
        }
        let Some(above) = rows.get(&(sensor, number + 1)) else { continue };
        for ray in row {
            let at = above.partition_point(|r| r.azimuth_rad < ray.azimuth_rad);
            let apart = |r: &Ray| f64::from((r.azimuth_rad - ray.azimuth_rad).abs());
            let beside = above[at.saturating_sub(1)..above.len().min(at + 1)].iter();
            let nearest = beside.min_by(|a, b| apart(a).total_cmp(&apart(b))).filter(|r| apart(r) < step);
            if let Some(over) = nearest {
                sum += of_pair(ray, over, f64::from((over.elevation_rad - ray.elevation_rad).abs()));
            }
        }
    }
    sum
}

/// Share of the places of an edge in a beam at which the mean of the two ranges is seen to lie between them.
fn mixing_share(a_m: f64, b_m: f64) -> f64 {
    let [near, far] = [a_m.min(b_m), a_m.max(b_m)];
    if !gap_mixes(near, far) {
        return 0.0;
    }
    // A disc at whose distance d from its middle (radius 1) an edge lies has this much on the nearer side.
    let margin = gap_margin_m(near) / (far - near);
    let covered = |d: f64| 0.5 - (d * (1.0 - d * d).sqrt() + d.asin()) / std::f64::consts::PI;
    let [mut low, mut high] = [0.0, 1.0];
    for _ in 0..30 {
        let middle = 0.5 * (low + high);
        *(if covered(middle) > margin { &mut low } else { &mut high }) = middle;
    }
    low
}
