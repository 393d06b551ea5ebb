//! Range discontinuities over which a beam mixes two surfaces: returns between the surfaces, and their expected
//! number by the width of the beam.

use super::ray::Ray;
use crate::inference::median;
use sensor::directions::{DirectionIndex, Neighbour};
use std::collections::BTreeMap;

/// Range discontinuities over which a beam mixes, m: smaller ones are not resolved, larger ones are longer than a
/// pulse.
pub const GAP_M: [f64; 2] = [1.2, 12.0];

/// Whether beams mix over a range discontinuity.
fn gap_mixes(near_m: f64, far_m: f64) -> bool {
    (GAP_M[0]..GAP_M[1]).contains(&(far_m - near_m))
}

/// Distance from either surface within which a return lies on it, m.
pub fn gap_margin_m(near_m: f64) -> f64 {
    0.35 + 0.015 * near_m
}

/// Whether a return at a range, m, lies between two surfaces, off both of them. `around` it are returns of one side.
pub(super) fn in_gap(around: &[Neighbour], range_m: f32) -> bool {
    let [mut near, mut far] = [0.0f32, f32::INFINITY];
    for Neighbour { entry, .. } in around {
        if entry.range_m < range_m {
            near = near.max(entry.range_m);
        } else {
            far = far.min(entry.range_m);
        }
    }
    let [range, near, far] = [range_m, near, far].map(f64::from);
    near > 0.0 && is_between(range, near, far)
}

/// Whether a range lies in a discontinuity over which beams mix, off both surfaces.
fn is_between(range_m: f64, near_m: f64, far_m: f64) -> bool {
    let margin = gap_margin_m(near_m);
    gap_mixes(near_m, far_m) && range_m > near_m + margin && range_m < far_m - margin
}

/// Expected number of mixed returns of a sensor's scan for each radian of beam width. An edge between two
/// neighbouring shots is hit with a probability of the beam width over their angle. `index` holds the scan. Two
/// returns of one shot are no neighbours. 0 where rows are not known.
pub(super) fn mixed_per_rad(rays: &[Ray], index: &DirectionIndex) -> f64 {
    let mut rows = BTreeMap::<u16, Vec<&Ray>>::new();
    for ray in rays.iter().filter(|r| r.row != u16::MAX) {
        rows.entry(ray.row).or_default().push(ray);
    }
    rows.values_mut().for_each(|row| row.sort_by(|a, b| a.azimuth_rad.total_cmp(&b.azimuth_rad)));
    let of_pair = |a: &Ray, b: &Ray, apart_rad: f64| {
        let mixes = if a.smooth || b.smooth { 0.0 } else { mixing_share(a, b, index) };
        mixes / apart_rad.max(1e-5)
    };
    let mut sum = 0.0;
    for (number, row) in &rows {
        let gaps = row.windows(2).map(|w| f64::from(w[1].azimuth_rad - w[0].azimuth_rad));
        let step = median(gaps.clone().collect());
        for (pair, gap) in row.windows(2).zip(gaps).filter(|(_, gap)| (0.3 * step..1.7 * step).contains(gap)) {
            sum += of_pair(pair[0], pair[1], gap * f64::from(pair[0].elevation_rad).cos());
        }
        let Some(above) = rows.get(&(number + 1)) else { continue };
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

/// Number of places of an edge in a beam that are averaged.
const PLACES: u32 = 24;

/// Share of the places of an edge in a beam at which the weighted mean of the two ranges lies between them, and
/// between all other ranges around.
fn mixing_share(a: &Ray, b: &Ray, index: &DirectionIndex) -> f64 {
    let [near, far] = [a.own_range_m().min(b.own_range_m()), a.own_range_m().max(b.own_range_m())];
    if !gap_mixes(near, far) {
        return 0.0;
    }
    let mut around = Vec::new();
    let [azimuth, elevation] = [a.azimuth_rad + b.azimuth_rad, a.elevation_rad + b.elevation_rad].map(|s| 0.5 * s);
    index.around(azimuth, elevation, |e, _, _| around.push(f64::from(e.range_m)));
    around.sort_by(f64::total_cmp);
    // Area of a unit disc beyond an edge at distance d from its middle, as a share.
    let covered = |d: f64| 0.5 - (d * (1.0 - d * d).sqrt() + d.asin()) / std::f64::consts::PI;
    let seen = (0..PLACES).filter(|k| {
        let share = covered(2.0 * (f64::from(*k) + 0.5) / f64::from(PLACES) - 1.0);
        let range = share * near + (1.0 - share) * far;
        let at = around.partition_point(|r| *r < range);
        let (Some(&below), Some(&above)) = (at.checked_sub(1).and_then(|i| around.get(i)), around.get(at)) else {
            return false;
        };
        is_between(range, below, above)
    });
    seen.count() as f64 / f64::from(PLACES)
}
