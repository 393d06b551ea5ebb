//! One-to-one matching of the returns of the two sides, by direction alone.

use sensor::directions::{DirectionIndex, ScanPattern, SensorScan, Steps};

/// For each return of `a` whether it has a counterpart in `b`, and the other way round.
///
/// Shots of the two sides may be interleaved: the common shift in azimuth, of each row where rows are known, is
/// subtracted first. The difference of the numbers of returns without a counterpart equals the difference of the
/// numbers of returns, whatever the matching.
pub fn match_directions(a: &SensorScan, b: &SensorScan, pattern: &ScanPattern, closes: bool) -> (Vec<bool>, Vec<bool>) {
    let steps = pattern.steps;
    let window = Steps { azimuth_rad: 1.5 * steps.azimuth_rad, elevation_rad: 0.7 * steps.elevation_rad };
    let index = DirectionIndex::new(b, window, closes);
    let (gate_az, gate_el) = (0.8f32, 0.5f32);
    let rows = [a, b].map(|scan| scan.elevation_rad.iter().map(|el| pattern.row(*el)).collect::<Vec<_>>());
    let shifts = row_shifts(a, &index, &rows, pattern, window);
    let mut pairs: Vec<(f32, u32, u32)> = Vec::with_capacity(a.len() * 2);
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
    pairs.sort_by(|x, y| x.0.total_cmp(&y.0).then(x.1.cmp(&y.1)).then(x.2.cmp(&y.2)));
    let (mut of_a, mut of_b) = (vec![false; a.len()], vec![false; b.len()]);
    for (_, i, j) in pairs {
        if !of_a[i as usize] && !of_b[j as usize] {
            (of_a[i as usize], of_b[j as usize]) = (true, true);
        }
    }
    (of_a, of_b)
}

/// Fewest pairs for the shift of a row.
const FEWEST: f64 = 20.0;

/// Circular mean of the offset to the nearest shot, in steps: one for each row, then one for all. `rows_of` the returns
/// of both sides.
fn row_shifts(
    a: &SensorScan,
    index: &DirectionIndex,
    rows_of: &[Vec<Option<usize>>; 2],
    pattern: &ScanPattern,
    window: Steps,
) -> Vec<f32> {
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
    sums.iter().map(|s| if s[2] >= FEWEST { angle(s) } else { all }).collect()
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
        };
        for phase in [0.0, 0.2, 0.5, 0.9] {
            let (a, b) = (scan(phase, 0.1, 1), scan(0.0, 0.0, 2));
            let (of_a, of_b) = match_directions(&a, &b, &pattern, false);
            let count = |v: &[bool]| v.iter().filter(|m| !**m).count() as i64;
            assert!(count(&of_a) <= 20, "{phase}: {} of the thinned side have none", count(&of_a));
            assert_eq!(count(&of_b) - count(&of_a), b.len() as i64 - a.len() as i64);
        }
    }
}
