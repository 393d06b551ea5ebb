//! Range discontinuities over which a beam meets two surfaces: how many returns it has of both, or between them, by its
//! width.

use super::row_edges::rows_of;
use crate::inference::median;
use sensor::directions::{DirectionIndex, SensorScan};

/// Range discontinuities over which a beam mixes, m: smaller ones are not resolved, larger ones are longer than a
/// pulse.
const GAP_M: [f64; 2] = [1.2, 12.0];

/// Whether beams mix over a range discontinuity.
fn gap_mixes(near_m: f64, far_m: f64) -> bool {
    (GAP_M[0]..GAP_M[1]).contains(&(far_m - near_m))
}

/// Distance from either surface within which a return lies on it, m.
pub fn gap_margin_m(near_m: f64) -> f64 {
    0.35 + 0.015 * near_m
}

/// Whether a range lies in a discontinuity over which beams mix, off both surfaces.
fn is_between(range_m: f64, near_m: f64, far_m: f64) -> bool {
    let margin = gap_margin_m(near_m);
    gap_mixes(near_m, far_m) && range_m > near_m + margin && range_m < far_m - margin
}

/// The returns of a scan, and their index.
pub(super) struct Returns<'a> {
    pub scan: &'a SensorScan,
    pub index: &'a DirectionIndex,
}

/// Expected number of mixed returns of a sensor's scan for each radian of beam width. An edge between two
/// neighbouring shots is hit with a probability of the beam width over their angle. `row` is the row of a return,
/// `smooth` whether the others around it lie on one surface. Two returns of one shot are no neighbours. 0 where rows
/// are not known.
pub(super) fn mixed_per_rad(
    returns: &Returns,
    row: impl Fn(usize) -> u16,
    mut smooth: impl FnMut(usize) -> bool,
) -> f64 {
    let SensorScan { azimuth_rad: azimuth, elevation_rad: elevation, .. } = returns.scan;
    let rows = rows_of(returns.scan, row);
    let mut of_pair = |a: usize, b: usize, apart_rad: f64| {
        let mixes = returns.gap_mixes(a, b) && !smooth(a) && !smooth(b);
        if mixes { returns.mixing_share(a, b) / apart_rad.max(1e-5) } else { 0.0 }
    };
    let mut sum = 0.0;
    for (number, row) in &rows {
        let gaps = row.windows(2).map(|w| f64::from(azimuth[w[1]] - azimuth[w[0]]));
        let step = median(gaps.clone().collect());
        for (pair, gap) in row.windows(2).zip(gaps).filter(|(_, gap)| (0.3 * step..1.7 * step).contains(gap)) {
            sum += of_pair(pair[0], pair[1], gap * f64::from(elevation[pair[0]]).cos());
        }
        let Some(above) = rows.get(&(number + 1)) else { continue };
        for &i in row {
            let at = above.partition_point(|&other| azimuth[other] < azimuth[i]);
            let apart = |other: usize| f64::from((azimuth[other] - azimuth[i]).abs());
            let beside = above[at.saturating_sub(1)..above.len().min(at + 1)].iter().copied();
            let nearest = beside.min_by(|a, b| apart(*a).total_cmp(&apart(*b))).filter(|other| apart(*other) < step);
            if let Some(over) = nearest {
                sum += of_pair(i, over, f64::from((elevation[over] - elevation[i]).abs()));
            }
        }
    }
    sum
}

/// Number of places of an edge in a beam that are averaged.
const PLACES: u32 = 24;

impl Returns<'_> {
    /// Ranges of two returns, the smaller one first, m.
    fn near_far_m(&self, a: usize, b: usize) -> [f64; 2] {
        let [a, b] = [a, b].map(|i| f64::from(self.scan.range_m[i]));
        [a.min(b), a.max(b)]
    }

    /// Whether beams mix over the discontinuity between two returns.
    fn gap_mixes(&self, a: usize, b: usize) -> bool {
        let [near, far] = self.near_far_m(a, b);
        gap_mixes(near, far)
    }

    /// Share of the places of an edge in a beam at which the weighted mean of the ranges of two returns lies between
    /// them, and between all other ranges around.
    fn mixing_share(&self, a: usize, b: usize) -> f64 {
        let [near, far] = self.near_far_m(a, b);
        let [azimuth, elevation] = [&self.scan.azimuth_rad, &self.scan.elevation_rad].map(|v| 0.5 * (v[a] + v[b]));
        let mut around = Vec::new();
        self.index.around(azimuth, elevation, |e, _, _| around.push(f64::from(e.range_m)));
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
}
