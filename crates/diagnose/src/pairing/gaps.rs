//! Range discontinuities over which a beam meets two surfaces: how many returns it has of both, or between them, by its
//! width.

use super::prediction::Predictor;
use super::row_edges::rows_of;
use crate::inference::median;
use sensor::directions::{DirectionIndex, SensorScan, Sensors};

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

/// Share of the returns of some scans, one of each sensor, that beams would mix over the jumps between them, for each
/// radian of their width.
pub fn mixed_per_rad(scans: &[SensorScan], sensors: &Sensors) -> f64 {
    let mixed: f64 = scans.iter().enumerate().map(|(sensor, scan)| mixed_of(sensors, sensor, scan)).sum();
    mixed / scans.iter().map(SensorScan::len).sum::<usize>().max(1) as f64
}

/// The returns of a scan, and their index.
struct Returns<'a> {
    scan: &'a SensorScan,
    index: &'a DirectionIndex,
}

/// Expected number of mixed returns of a sensor's scan for each radian of beam width. An edge between two
/// neighbouring shots is hit with a probability of the beam width over their angle. Where the others around a return
/// lie on one surface there is no edge. Two returns of one shot are no neighbours. 0 where rows are not known.
fn mixed_of(sensors: &Sensors, sensor: usize, scan: &SensorScan) -> f64 {
    let predictor = Predictor::new(sensors, sensor, scan, &[]);
    let (mut smooth, mut neighbours) = (vec![None; scan.len()], Vec::new());
    let mut smooth = |i: usize| *smooth[i].get_or_insert_with(|| predictor.is_smooth(scan, i, &mut neighbours));
    let returns = Returns { scan, index: &predictor.around.index };
    let SensorScan { azimuth_rad: azimuth, elevation_rad: elevation, .. } = scan;
    let rows = rows_of(scan, |i| sensors.row(sensor, elevation[i], scan.range_m[i]));
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

#[cfg(test)]
mod tests {
    use super::*;
    use sensor::Rig;
    use sensor::directions::{ScanPattern, Steps};

    /// A board before a wall, over some columns: its two upright edges are crossed by every row.
    fn board(columns: std::ops::Range<usize>) -> SensorScan {
        let mut scan = SensorScan::default();
        for (row, column) in (0..ROWS).flat_map(|row| (0..COLUMNS).map(move |column| (row, column))) {
            scan.elevation_rad.push(row as f32 * 0.01);
            scan.azimuth_rad.push(column as f32 * STEP_RAD);
            scan.range_m.push(if columns.contains(&column) { 10.0 } else { 14.0 });
        }
        scan
    }

    const ROWS: usize = 12;
    const COLUMNS: usize = 200;
    const STEP_RAD: f32 = 0.004;

    #[test]
    fn beams_mix_over_edges_as_their_width_is_to_the_step() {
        let pattern = ScanPattern {
            rows_rad: (0..ROWS).map(|row| row as f32 * 0.01).collect(),
            steps: Steps { azimuth_rad: STEP_RAD, elevation_rad: 0.01 },
            ..ScanPattern::default()
        };
        let sensors = Sensors { rig: Rig::single(), patterns: vec![pattern], edge_m: 0.12 };
        assert_eq!(mixed_per_rad(&[board(0..0)], &sensors), 0.0);
        let edges = 2.0 * ROWS as f64 / (f64::from(STEP_RAD) * (ROWS * COLUMNS) as f64);
        let mixed = mixed_per_rad(&[board(80..120)], &sensors);
        // Of the places of an edge in a beam some put the mean range onto one of both surfaces.
        assert!((0.6 * edges..edges).contains(&mixed), "{mixed} {edges}");
    }
}
