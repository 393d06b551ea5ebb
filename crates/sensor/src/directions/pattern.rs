//! Rows and angular steps of a sensor, estimated from the directions of its returns.

use super::scan::{SensorScan, Steps};
use statistics::weighted_median;

/// Scan pattern of a sensor.
#[derive(Clone, Debug, PartialEq)]
pub struct ScanPattern {
    /// Elevation of each row from the lowest, rad; empty where no rows are found.
    pub rows_rad: Vec<f32>,
    /// Typical angle between neighbouring shots.
    pub steps: Steps,
}

/// Width of a bin of the histogram of elevations, rad.
const BIN_RAD: f32 = 3.5e-4;

impl ScanPattern {
    /// Whether an elevation, rad, is among the rows or within half a step beside them; true where no rows are known.
    pub fn reaches(&self, elevation_rad: f64) -> bool {
        let (Some(&lowest), Some(&highest)) = (self.rows_rad.first(), self.rows_rad.last()) else { return true };
        let beside = self.steps.elevation_rad / 2.0;
        (f64::from(lowest - beside)..=f64::from(highest + beside)).contains(&elevation_rad)
    }

    /// From scans of several frames of both sides, whose shots have the same directions.
    pub fn of_scans(scans: &[&SensorScan]) -> ScanPattern {
        let mut rows_rad = rows(scans);
        let azimuth = azimuth_step(scans, &rows_rad);
        if rows_rad.len() < 4 || azimuth.is_none() {
            rows_rad.clear();
        }
        let steps = match azimuth {
            Some(azimuth_rad) if !rows_rad.is_empty() => {
                let mut gaps: Vec<f32> = rows_rad.windows(2).map(|w| w[1] - w[0]).collect();
                gaps.sort_by(f32::total_cmp);
                Steps { azimuth_rad, elevation_rad: gaps[gaps.len() * 3 / 4] }
            }
            _ => even_steps(scans),
        };
        ScanPattern { rows_rad, steps }
    }

    /// Row of an elevation; `None` without rows, or farther from the nearest than 0.4 of its distance to the next.
    pub fn row(&self, elevation_rad: f32) -> Option<usize> {
        let rows = &self.rows_rad;
        if rows.is_empty() {
            return None;
        }
        let i = rows.partition_point(|r| *r < elevation_rad);
        let nearest = if i == 0 {
            0
        } else if i == rows.len() || elevation_rad - rows[i - 1] < rows[i] - elevation_rad {
            i - 1
        } else {
            i
        };
        let gap = match nearest {
            0 => rows[1] - rows[0],
            last if last + 1 == rows.len() => rows[last] - rows[last - 1],
            i => (rows[i + 1] - rows[i]).min(rows[i] - rows[i - 1]),
        };
        ((rows[nearest] - elevation_rad).abs() < 0.4 * gap).then_some(nearest)
    }
}

/// Half width of the window of the local mean of the histogram, bins: 0.9 degrees.
const REACH: usize = 45;

/// A bin belongs to a cluster if it has at least this share of the local mean.
const OF_LOCAL_MEAN: f32 = 0.35;

/// A cluster of elevations.
struct Cluster {
    /// Mean elevation, rad.
    centre: f32,
    /// rad.
    width: f32,
    /// Returns.
    count: f32,
}

/// Elevations of the rows: clusters of the returns' elevations. Empty where clusters do not stand out: fewer than
/// four, less than 80 % of the returns in them, or the cluster of the median return wider than 60 % of their
/// distance.
fn rows(scans: &[&SensorScan]) -> Vec<f32> {
    let mut found = clusters(scans);
    let total: usize = scans.iter().map(|s| s.len()).sum();
    // False alarms between the rows make small clusters.
    let mut sizes: Vec<f32> = found.iter().map(|c| c.count).collect();
    sizes.sort_by(f32::total_cmp);
    let usual = sizes.get(sizes.len() / 2).copied().unwrap_or(0.0);
    found.retain(|c| c.count > 0.02 * usual);
    let inside: f32 = found.iter().map(|c| c.count).sum();
    // The width of the cluster of the median return: beside one wide cluster of scattered shots there are narrow ones
    // by chance, with few returns.
    let widths = found.iter().map(|c| (f64::from(c.width), f64::from(c.count))).collect();
    let mut gaps: Vec<f32> = found.windows(2).map(|w| w[1].centre - w[0].centre).collect();
    gaps.sort_by(f32::total_cmp);
    let (Some(width), Some(gap)) = (weighted_median(widths), gaps.get(gaps.len() / 2)) else { return vec![] };
    if found.len() < 4 || inside < 0.8 * total as f32 || width > 0.6 * f64::from(*gap) {
        return vec![];
    }
    found.into_iter().map(|c| c.centre).collect()
}

/// Clusters of the histogram of elevations: bins above a share of the local mean, with gaps of at most one bin.
fn clusters(scans: &[&SensorScan]) -> Vec<Cluster> {
    let low = scans.iter().flat_map(|s| &s.elevation_rad).copied().fold(f32::INFINITY, f32::min);
    let high = scans.iter().flat_map(|s| &s.elevation_rad).copied().fold(f32::NEG_INFINITY, f32::max);
    if !(high > low) {
        return vec![];
    }
    let n = ((high - low) / BIN_RAD) as usize + 1;
    let (mut counts, mut sums) = (vec![0.0f32; n], vec![0.0f64; n]);
    for &el in scans.iter().flat_map(|s| &s.elevation_rad) {
        let bin = (((el - low) / BIN_RAD) as usize).min(n - 1);
        counts[bin] += 1.0;
        sums[bin] += f64::from(el);
    }
    let dense = dense_bins(&counts);
    let mut found = Vec::new();
    let mut i = 0;
    while i < n {
        if !dense[i] {
            i += 1;
            continue;
        }
        let begin = i;
        let (mut count, mut sum, mut gap) = (0.0, 0.0, 0);
        let mut end = i;
        while i < n && gap < 2 {
            if dense[i] {
                (count, sum, gap, end) = (count + counts[i], sum + sums[i], 0, i + 1);
            } else {
                gap += 1;
            }
            i += 1;
        }
        let centre = (sum / f64::from(count)) as f32;
        found.push(Cluster { centre, width: (end - begin) as f32 * BIN_RAD, count });
    }
    found
}

/// Whether each bin of a histogram exceeds a share of the local mean.
fn dense_bins(counts: &[f32]) -> Vec<bool> {
    let n = counts.len();
    let cumulative: Vec<f32> = std::iter::once(0.0)
        .chain(counts.iter().scan(0.0, |sum, c| {
            *sum += c;
            Some(*sum)
        }))
        .collect();
    let local = |i: usize| {
        let (a, b) = (i.saturating_sub(REACH), (i + REACH + 1).min(n));
        (cumulative[b] - cumulative[a]) / (b - a) as f32
    };
    (0..n).map(|i| counts[i] > OF_LOCAL_MEAN * local(i) && counts[i] >= 1.0).collect()
}

/// The usual difference of neighbouring azimuths within a row.
fn azimuth_step(scans: &[&SensorScan], rows: &[f32]) -> Option<f32> {
    if rows.len() < 4 {
        return None;
    }
    let pattern = ScanPattern { rows_rad: rows.to_vec(), steps: Steps { azimuth_rad: 0.0, elevation_rad: 0.0 } };
    let mut differences = Vec::new();
    for scan in scans {
        let mut by_row: Vec<Vec<f32>> = vec![Vec::new(); rows.len()];
        for i in 0..scan.len() {
            if let Some(row) = pattern.row(scan.elevation_rad[i]) {
                by_row[row].push(scan.azimuth_rad[i]);
            }
        }
        for row in &mut by_row {
            row.sort_by(f32::total_cmp);
            differences.extend(row.windows(2).map(|w| w[1] - w[0]));
        }
    }
    if differences.len() < 100 {
        return None;
    }
    differences.sort_by(f32::total_cmp);
    let step = differences[differences.len() * 2 / 5];
    (step > 1e-5).then_some(step)
}

/// The step of returns spread evenly: the same in both angles.
fn even_steps(scans: &[&SensorScan]) -> Steps {
    let cell = 0.02f32;
    let mut counts = Vec::new();
    for scan in scans {
        let mut cells = std::collections::BTreeMap::new();
        for i in 0..scan.len() {
            let key = ((scan.azimuth_rad[i] / cell).floor() as i32, (scan.elevation_rad[i] / cell).floor() as i32);
            *cells.entry(key).or_insert(0usize) += 1;
        }
        counts.extend(cells.into_values());
    }
    counts.sort_unstable();
    let usual = counts.get(counts.len() * 3 / 4).copied().unwrap_or(1).max(1);
    let step = cell / (usual as f32).sqrt();
    Steps { azimuth_rad: step, elevation_rad: step }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;

    #[test]
    fn rows_are_found_in_any_order_of_points() {
        let mut rng = data::stream(1, "pattern", 0, 0);
        let truth: Vec<f32> = (0..24).map(|i| (-16.0 + 0.7 * i as f32 + 0.01 * (i * i) as f32).to_radians()).collect();
        let scans: Vec<SensorScan> = (0..6)
            .map(|_| {
                let mut scan = SensorScan::default();
                for el in &truth {
                    for j in 0..200 {
                        if rng.random_bool(0.8) {
                            scan.azimuth_rad.push(-1.0 + 0.01 * (j as f32 + 0.2 * rng.random::<f32>()));
                            scan.elevation_rad.push(el + 4e-4 * (rng.random::<f32>() - 0.5));
                            scan.range_m.push(10.0);
                        }
                    }
                }
                scan
            })
            .collect();
        let pattern = ScanPattern::of_scans(&scans.iter().collect::<Vec<_>>());
        assert_eq!(pattern.rows_rad.len(), 24);
        assert!(pattern.rows_rad.iter().zip(&truth).all(|(a, b)| (a - b).abs() < 1e-4));
        assert!((pattern.steps.azimuth_rad - 0.01).abs() < 1e-3, "{:?}", pattern.steps);
        assert_eq!(pattern.row(truth[7] + 1e-3), Some(7));
        let beside = f64::from(pattern.steps.elevation_rad) / 2.0;
        for (end, out) in [(truth[0], -1.0), (truth[23], 1.0)] {
            let [inside, outside] = [0.9, 1.1].map(|share| pattern.reaches(f64::from(end) + out * share * beside));
            assert!(inside && !outside);
        }
    }

    #[test]
    fn a_rosette_has_no_rows() {
        let mut rng = data::stream(3, "pattern", 0, 0);
        let scans: Vec<SensorScan> = (0..6)
            .map(|_| {
                let mut scan = SensorScan::default();
                let phases: [f64; 2] = [rng.random_range(0.0..6.3), rng.random_range(0.0..6.3)];
                for i in 0..17_000 {
                    let turn = i as f64 * 0.011;
                    let [a, b] = [turn + phases[0], -0.787 * turn + phases[1]];
                    let (az, el) = (0.3 * a.cos() + 0.31 * b.cos(), 0.3 * a.sin() + 0.31 * b.sin());
                    // Sky above the horizon, but for some posts.
                    if el < 0.1 || (az * 9.0).sin() > 0.9 {
                        scan.azimuth_rad.push(az as f32);
                        scan.elevation_rad.push(el as f32);
                        scan.range_m.push(10.0);
                    }
                }
                scan
            })
            .collect();
        let pattern = ScanPattern::of_scans(&scans.iter().collect::<Vec<_>>());
        assert!(pattern.rows_rad.is_empty(), "{:?}", pattern.rows_rad);
    }

    #[test]
    fn scattered_shots_have_no_rows() {
        let mut rng = data::stream(2, "pattern", 0, 0);
        let mut scan = SensorScan::default();
        for _ in 0..20_000 {
            scan.azimuth_rad.push(rng.random_range(-1.0..1.0));
            scan.elevation_rad.push(rng.random_range(-0.3..0.1));
            scan.range_m.push(10.0);
        }
        let pattern = ScanPattern::of_scans(&[&scan]);
        assert!(pattern.rows_rad.is_empty());
        assert!((pattern.steps.azimuth_rad / (0.8f32 / 20_000.0).sqrt() - 1.0).abs() < 0.2, "{:?}", pattern.steps);
    }
}
