//! One-to-one matching of the returns of the two sides, by direction alone.

use sensor::directions::{DirectionIndex, ScanPattern, SensorScan, Steps};

/// Of one sensor which returns have a counterpart on the other side.
#[derive(Clone, Debug)]
pub struct Matched {
    /// Of the measured side.
    pub measured: Vec<bool>,
    /// Of the simulated side.
    pub simulated: Vec<bool>,
    /// Whether both sides send their shots in the same directions, but for a shift.
    pub repeats: bool,
}

/// For each return of `a`, the measured side, whether it has a counterpart in `b`, and the other way round.
///
/// Shots of the two sides may be interleaved: the common shift in azimuth, of each row where rows are known, is
/// subtracted first. A pattern without rows that does not repeat has no common shift: there a counterpart is any return
/// within a few steps, so that densities of returns are compared instead of single directions. The difference of the
/// numbers of returns without a counterpart equals the difference of the numbers of returns, whatever the matching.
pub fn match_directions(a: &SensorScan, b: &SensorScan, pattern: &ScanPattern, closes: bool) -> Matched {
    let steps = pattern.steps;
    let window = Steps { azimuth_rad: 1.5 * steps.azimuth_rad, elevation_rad: 0.7 * steps.elevation_rad };
    let rows_of = |scan: &SensorScan| {
        scan.elevation_rad.iter().zip(&scan.range_m).map(|(el, m)| pattern.row(*el, *m)).collect::<Vec<_>>()
    };
    let rows = [a, b].map(rows_of);
    let index = DirectionIndex::new(b, window, closes);
    let (shifts, common) = row_shifts(a, &index, &rows, pattern, window);
    let repeats = !pattern.rows_rad.is_empty() || common >= COMMON;
    let mut matched = Matched { measured: vec![false; a.len()], simulated: vec![false; b.len()], repeats };
    if !repeats {
        for reach in REACHES {
            let window = Steps { azimuth_rad: reach * steps.azimuth_rad, elevation_rad: reach * steps.elevation_rad };
            match_within([a, b], window, closes, &mut matched);
        }
        return matched;
    }
    let (gate_az, gate_el) = (0.8f32, 0.5f32);
    let mut pairs = Vec::with_capacity(a.len() * 2);
    for i in 0..a.len() {
        let el = a.elevation_rad[i];
        let row = rows[0][i];
        let shift = shifts[row.map_or(shifts.len() - 1, |r| r)];
        index.around(a.azimuth_rad[i] + shift * steps.azimuth_rad, el, |entry, dx, dy| {
            let (dx, dy) = (dx * 1.5, dy * 0.7);
            let same_row = row.is_none() || row == rows[1][entry.index as usize];
            if dx.abs() <= gate_az && dy.abs() <= gate_el && same_row {
                pairs.push((dx * dx + dy * dy, i as u32, entry.index));
            }
        });
    }
    nearest_first(pairs, &mut matched);
    matched
}

/// A pair of returns that may be matched: the square of their distance, and the numbers of both.
type Pair = (f32, u32, u32);

/// Matches the nearest pairs first, each return once.
fn nearest_first(mut pairs: Vec<Pair>, matched: &mut Matched) {
    let (of_a, of_b) = (&mut matched.measured, &mut matched.simulated);
    pairs.sort_by(|x, y| x.0.total_cmp(&y.0).then(x.1.cmp(&y.1)).then(x.2.cmp(&y.2)));
    for (_, i, j) in pairs {
        if !of_a[i as usize] && !of_b[j as usize] {
            (of_a[i as usize], of_b[j as usize]) = (true, true);
        }
    }
}

/// Length of the mean of the offsets to the nearest shots, as angles of a full turn a step, above which two patterns
/// without rows send their shots in the same directions: 1 where all offsets are the same, about 0.1 where they are
/// independent.
const COMMON: f64 = 0.5;

/// Angles, in steps, up to which returns of patterns that do not repeat are matched, nearest first: the larger ones
/// only concern what the smaller ones left. Two draws of a rosette of 25,000 shots leave 40 % of the returns without a
/// counterpart within 0.65 steps, and 9 % within 4.
const REACHES: [f32; 3] = [1.0, 2.0, 4.0];

/// Matches returns that have no counterpart yet, nearest first, within an ellipse.
fn match_within([a, b]: [&SensorScan; 2], window: Steps, closes: bool, matched: &mut Matched) {
    let left = |of: &[bool]| (0..of.len()).filter(|&i| !of[i]).collect::<Vec<usize>>();
    let [of_a, of_b] = [left(&matched.measured), left(&matched.simulated)];
    let directions = SensorScan {
        azimuth_rad: of_b.iter().map(|&j| b.azimuth_rad[j]).collect(),
        elevation_rad: of_b.iter().map(|&j| b.elevation_rad[j]).collect(),
        range_m: of_b.iter().map(|&j| b.range_m[j]).collect(),
        intensity: vec![],
    };
    let index = DirectionIndex::new(&directions, window, closes);
    let mut pairs = Vec::new();
    for i in of_a {
        index.around(a.azimuth_rad[i], a.elevation_rad[i], |entry, dx, dy| {
            let distance = dx * dx + dy * dy;
            if distance <= 1.0 {
                pairs.push((distance, i as u32, of_b[entry.index as usize] as u32));
            }
        });
    }
    nearest_first(pairs, matched);
}

/// Fewest pairs for the shift of a row.
const FEWEST: f64 = 20.0;

/// Circular mean of the offset to the nearest shot, in steps: one for each row, then one for all; and how much all
/// offsets have in common, 0 to 1. `rows_of` the returns of both sides.
fn row_shifts(
    a: &SensorScan,
    index: &DirectionIndex,
    rows_of: &[Vec<Option<usize>>; 2],
    pattern: &ScanPattern,
    window: Steps,
) -> (Vec<f32>, f64) {
    let rows = pattern.rows_rad.len();
    let mut sums = vec![[0.0f64; 3]; rows + 1];
    for i in 0..a.len() {
        let row = rows_of[0][i];
        let mut nearest: Option<(f32, f32)> = None;
        index.around(a.azimuth_rad[i], a.elevation_rad[i], |entry, dx, dy| {
            if row.is_none() || row == rows_of[1][entry.index as usize] {
                let distance = dx * dx + dy * dy;
                if nearest.is_none_or(|(d, _)| distance < d) {
                    nearest = Some((distance, dx * window.azimuth_rad / pattern.steps.azimuth_rad));
                }
            }
        });
        if let Some((_, offset)) = nearest {
            let (s, c) = (std::f64::consts::TAU * f64::from(offset)).sin_cos();
            for k in [row.unwrap_or(rows), rows] {
                sums[k][0] += s;
                sums[k][1] += c;
                sums[k][2] += 1.0;
            }
        }
    }
    let angle = |s: &[f64; 3]| (s[0].atan2(s[1]) / std::f64::consts::TAU) as f32;
    let all = angle(&sums[rows]);
    let [s, c, n] = sums[rows];
    (sums.iter().map(|s| if s[2] >= FEWEST { angle(s) } else { all }).collect(), s.hypot(c) / n.max(1.0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;

    fn scan(phase: f32, lost: f64, seed: u64) -> SensorScan {
        let mut rng = data::stream(seed, "matching", 0, 0);
        let mut scan = SensorScan::default();
        for row in 0..10 {
            for j in 0..300 {
                if !rng.random_bool(lost) {
                    scan.azimuth_rad.push(-1.5 + 0.01 * (j as f32 + phase));
                    scan.elevation_rad.push(-0.2 + 0.02 * row as f32);
                    scan.range_m.push(10.0);
                }
            }
        }
        scan
    }

    #[test]
    fn shots_between_shots_still_match() {
        let pattern = ScanPattern {
            rows_rad: (0..10).map(|r| -0.2 + 0.02 * r as f32).collect(),
            steps: Steps { azimuth_rad: 0.01, elevation_rad: 0.02 },
            ..ScanPattern::default()
        };
        for phase in [0.0, 0.2, 0.5, 0.9] {
            let (a, b) = (scan(phase, 0.1, 1), scan(0.0, 0.0, 2));
            let Matched { measured: of_a, simulated: of_b, .. } = match_directions(&a, &b, &pattern, false);
            let count = |v: &[bool]| v.iter().filter(|m| !**m).count() as i64;
            assert!(count(&of_a) <= 20, "{phase}: {} of the thinned side have none", count(&of_a));
            assert_eq!(count(&of_b) - count(&of_a), b.len() as i64 - a.len() as i64);
        }
    }

    /// Returns of a rosette that begins anywhere; below -0.1 rad a share is lost.
    fn rosette(lost: f64, seed: u64) -> SensorScan {
        let mut rng = data::stream(seed, "matching", 1, 0);
        let begin: [f64; 2] = [rng.random_range(0.0..6.3), rng.random_range(0.0..6.3)];
        let mut scan = SensorScan::default();
        for i in 0..25_000 {
            let turn = std::f64::consts::TAU * f64::from(i) / 25_000.0;
            let [a, b] = [61.55 * turn + begin[0], -38.95 * turn + begin[1]];
            let el = 0.325 * a.sin() + 0.286 * b.sin();
            if el > -0.1 || !rng.random_bool(lost) {
                scan.azimuth_rad.push((0.325 * a.cos() + 0.286 * b.cos()) as f32);
                scan.elevation_rad.push(el as f32);
                scan.range_m.push(10.0);
            }
        }
        scan
    }

    #[test]
    fn a_rosette_that_does_not_repeat_is_compared_by_its_density() {
        let scans = [rosette(0.2, 1), rosette(0.0, 2)];
        let pattern = ScanPattern::of_scans(&scans.each_ref());
        assert!(pattern.rows_rad.is_empty());
        let Matched { measured: of_a, simulated: of_b, repeats } =
            match_directions(&scans[0], &scans[1], &pattern, false);
        assert!(!repeats);
        let alone = |scan: &SensorScan, of: &[bool], low: bool| {
            let there = |i: &usize| (scan.elevation_rad[*i] < -0.1) == low;
            let all: Vec<usize> = (0..scan.len()).filter(there).collect();
            all.iter().filter(|&&i| !of[i]).count() as f64 / all.len() as f64
        };
        // Where nothing is lost both have few alone, and the same share; where a fifth is lost, about that share.
        let [low, high] = [true, false].map(|low| [alone(&scans[0], &of_a, low), alone(&scans[1], &of_b, low)]);
        assert!(high[0] < 0.12 && (high[0] - high[1]).abs() < 0.01, "{high:?}");
        assert!((low[1] - low[0] - 0.2).abs() < 0.03, "{low:?}");
    }

    #[test]
    fn a_pattern_without_rows_that_repeats_is_compared_shot_by_shot() {
        let all = rosette(0.0, 3);
        let pattern = ScanPattern::of_scans(&[&all]);
        let some = rosette(0.2, 3);
        let Matched { measured: of_some, simulated: of_all, repeats } = match_directions(&some, &all, &pattern, false);
        assert!(repeats);
        assert!(of_some.iter().all(|m| *m));
        let alone = |i: &usize| !of_all[*i];
        assert!((0..all.len()).filter(alone).all(|i| all.elevation_rad[i] < -0.1), "none where nothing is lost");
    }
}
