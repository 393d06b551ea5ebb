//! Edges in the rows of one side: places where the range jumps from one level to another, and the returns between the
//! two levels. A beam that meets both reports a range between them, if the jump is shorter than its pulse. Each side is
//! looked at by itself: where the edges lie, and whether the scene is displaced, does not matter.

use super::ray::{OCTANTS, octant_of};
use crate::inference::median;
use sensor::directions::{SensorScan, Sensors};
use std::collections::BTreeMap;

/// Smallest and largest jump, m: smaller ones are not resolved, longer ones than any pulse.
const JUMPS_M: [f64; 2] = [0.4, 12.0];

/// Bins of jumps, evenly spread in the logarithm.
pub const JUMPS: usize = 14;

/// Largest difference of a range from the level of its side, as a share of the jump. What is farther from both levels
/// lies between them.
pub const LEVEL: f64 = 0.15;

/// Most returns between the two levels of an edge: a surface that is seen at an angle goes over in several.
const MOST_BETWEEN: usize = 1;

/// Distances of neighbouring shots of a row, in steps.
const STEPS: std::ops::Range<f64> = 0.5..1.5;

/// Share of the width of a beam within which an edge mixes ranges that lie between the levels: 0.52 of a Gaussian beam
/// (to 1/e2), 0.58 of a uniform disc.
const MIXES: f64 = 0.55;

/// Edges with jumps of about one size.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Jumps {
    /// Their number.
    pub edges: f64,
    /// Returns between their levels.
    pub between: f64,
    /// Such returns that beams make for each radian of their width.
    pub per_rad: f64,
}

impl Jumps {
    /// Adds others.
    pub fn merge(&mut self, other: &Jumps) {
        self.edges += other.edges;
        self.between += other.between;
        self.per_rad += other.per_rad;
    }
}

/// The edges of one side of a frame, by octant of the azimuth and by jump.
pub type RowEdges = [[Jumps; JUMPS]; OCTANTS];

/// The edges of all sensors of a frame.
pub(super) fn edges_of(scans: &[SensorScan], sensors: &Sensors) -> RowEdges {
    let mut sum = RowEdges::default();
    for (sensor, scan) in scans.iter().enumerate() {
        let of_scan = row_edges(scan, |i| sensors.row(sensor, scan.elevation_rad[i], scan.range_m[i]));
        sum.iter_mut().flatten().zip(of_scan.iter().flatten()).for_each(|(all, one)| all.merge(one));
    }
    sum
}

/// The returns of each row of a scan, in the order of their azimuths; none of those whose row is `u16::MAX`: it is not
/// known.
pub(super) fn rows_of(scan: &SensorScan, row_of: impl Fn(usize) -> u16) -> BTreeMap<u16, Vec<usize>> {
    let mut rows = BTreeMap::<u16, Vec<usize>>::new();
    for (i, row) in (0..scan.len()).map(|i| (i, row_of(i))).filter(|(_, row)| *row != u16::MAX) {
        rows.entry(row).or_default().push(i);
    }
    let azimuth = &scan.azimuth_rad;
    rows.values_mut().for_each(|row| row.sort_by(|a, b| azimuth[*a].total_cmp(&azimuth[*b])));
    rows
}

/// The smallest jump of a bin, or one within it, m.
pub fn jump_m(bin: f64) -> f64 {
    JUMPS_M[0] * (JUMPS_M[1] / JUMPS_M[0]).powf(bin / JUMPS as f64)
}

fn bin(jump_m: f64) -> Option<usize> {
    let at = (jump_m / JUMPS_M[0]).ln() / (JUMPS_M[1] / JUMPS_M[0]).ln() * JUMPS as f64;
    (0.0..JUMPS as f64).contains(&at).then_some(at as usize)
}

/// The edges of a scan; `row_of` is the row of a return.
fn row_edges(scan: &SensorScan, row_of: impl Fn(usize) -> u16) -> RowEdges {
    let mut out = RowEdges::default();
    for shots in rows_of(scan, row_of).values() {
        let gaps: Vec<f64> =
            shots.windows(2).map(|w| f64::from(scan.azimuth_rad[w[1]] - scan.azimuth_rad[w[0]])).collect();
        let step = median(gaps.clone());
        let ranges: Vec<f64> = shots.iter().map(|&i| f64::from(scan.range_m[i])).collect();
        for first in 0..shots.len().saturating_sub(3) {
            let together = gaps[first..].iter().take_while(|gap| STEPS.contains(&(*gap / step))).count();
            let longest = (together + 1).min(MOST_BETWEEN + 4);
            let found = (4..=longest).find_map(|n| Some((n - 4, edge(&ranges[first..first + n])?)));
            let Some((between, bin)) = found else { continue };
            let at = shots[first + 1];
            let apart_rad = step * f64::from(scan.elevation_rad[at]).cos();
            out[octant_of(scan.azimuth_rad[at].into())][bin].merge(&Jumps {
                edges: 1.0,
                between: between as f64,
                per_rad: MIXES / apart_rad.max(1e-5),
            });
        }
    }
    out
}

/// The bin of the jump between the first two and the last two of some neighbouring ranges, where all others lie between
/// the two levels; `None` where there is no such edge.
fn edge(ranges: &[f64]) -> Option<usize> {
    let &[before, a, ref between @ .., b, after] = ranges else { return None };
    let jump = b - a;
    let share = |range: f64| (range - a) / jump;
    let level = share(before).abs() < LEVEL && (share(after) - 1.0).abs() < LEVEL;
    let lies_between = between.iter().all(|r| (LEVEL..1.0 - LEVEL).contains(&share(*r)));
    if level && lies_between { bin(jump.abs()) } else { None }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEP: f32 = 0.01;

    /// A row of shots.
    fn scan(ranges: &[f32]) -> SensorScan {
        SensorScan {
            azimuth_rad: (0..ranges.len()).map(|k| k as f32 * STEP).collect(),
            elevation_rad: vec![0.0; ranges.len()],
            range_m: ranges.to_vec(),
            intensity: vec![],
        }
    }

    fn total(ranges: &[f32]) -> Jumps {
        let mut sum = Jumps::default();
        row_edges(&scan(ranges), |_| 0).iter().flatten().for_each(|jumps| sum.merge(jumps));
        sum
    }

    #[test]
    fn an_edge_is_counted_once_with_the_returns_between_its_levels() {
        let sharp = total(&[10.0, 10.0, 10.1, 13.0, 13.0, 13.1]);
        assert_eq!((sharp.edges, sharp.between), (1.0, 0.0));
        assert!((sharp.per_rad * f64::from(STEP) / MIXES - 1.0).abs() < 1e-4);
        let mixed = total(&[10.0, 10.0, 10.0, 11.5, 13.0, 13.0, 13.0]);
        assert_eq!((mixed.edges, mixed.between), (1.0, 1.0));
        assert_eq!(total(&[10.0, 10.0, 10.0, 11.0, 12.0, 13.0, 13.0, 13.0]).edges, 0.0, "a surface seen at an angle");
    }

    #[test]
    fn walls_that_are_seen_at_an_angle_and_single_returns_are_no_edges() {
        let slanted: Vec<f32> = (0..30).map(|k| 10.0 + 0.7 * k as f32).collect();
        assert_eq!(total(&slanted).edges, 0.0);
        assert_eq!(total(&[10.0, 10.0, 10.0, 13.0, 10.0, 10.0]).edges, 0.0);
        // Nothing was received where the edge may be.
        let mut torn = scan(&[10.0, 10.0, 13.0, 13.0]);
        torn.azimuth_rad[2..].iter_mut().for_each(|azimuth| *azimuth += 5.0 * STEP);
        assert!(row_edges(&torn, |_| 0).iter().flatten().all(|j| *j == Jumps::default()));
        assert!(row_edges(&scan(&[10.0, 10.0, 13.0, 13.0]), |_| u16::MAX).iter().flatten().all(|j| j.edges == 0.0));
    }

    #[test]
    fn bins_hold_their_jumps() {
        assert!((0..JUMPS).all(|k| bin(jump_m(k as f64) * 1.01) == Some(k)));
        assert!(bin(0.39).is_none() && bin(12.1).is_none());
    }
}
