//! Rows and angular steps of a sensor, estimated from the directions of its returns.

use super::lasers;
use super::scan::{SensorScan, Steps};
use statistics::weighted_median;

/// Scan pattern of a sensor.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ScanPattern {
    /// Elevation of each row from the lowest, rad; empty where no rows are found.
    pub rows_rad: Vec<f32>,
    /// Height of the origin of each row's rays over that of the sensor, m; empty where all rays start there. Seen from
    /// the sensor's origin such a row is at another elevation for each range.
    pub heights_m: Vec<f32>,
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
        let (mut rows_rad, mut heights_m) = (rows(scans), Vec::new());
        if rows_rad.is_empty() {
            (rows_rad, heights_m) = rows_of_lasers(scans);
        }
        let azimuth = azimuth_step(scans, &rows_rad, &heights_m);
        if rows_rad.len() < 4 || azimuth.is_none() {
            rows_rad.clear();
            heights_m.clear();
        }
        let steps = match azimuth {
            Some(azimuth_rad) if !rows_rad.is_empty() => {
                let mut gaps: Vec<f32> = rows_rad.windows(2).map(|w| w[1] - w[0]).collect();
                gaps.sort_by(f32::total_cmp);
                Steps { azimuth_rad, elevation_rad: gaps[gaps.len() * 3 / 4] }
            }
            _ => even_steps(scans),
        };
        ScanPattern { rows_rad, heights_m, steps }
    }

    /// Row of a return at an elevation and a range, infinite for shots without one; `None` without rows, or farther
    /// from the nearest than 0.4 of its distance to the next.
    pub fn row(&self, elevation_rad: f32, range_m: f32) -> Option<usize> {
        let rows = &self.rows_rad;
        if rows.is_empty() {
            return None;
        }
        if !self.heights_m.is_empty() {
            return self.row_of_lasers(elevation_rad, range_m);
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

    /// The same for rows with heights of their own: the row on whose cone the return lies.
    fn row_of_lasers(&self, elevation_rad: f32, range_m: f32) -> Option<usize> {
        let (mut nearest, mut next) = ((f32::INFINITY, 0), f32::INFINITY);
        let most_rad = self.heights_m.iter().fold(0.0, |most: f32, m| most.max(m.abs())) / range_m;
        for (row, (at, height_m)) in self.rows_rad.iter().zip(&self.heights_m).enumerate() {
            if (elevation_rad - at).abs() - most_rad > next {
                continue;
            }
            let off = (elevation_rad - at - height_m * at.cos() / range_m).abs();
            if off < nearest.0 {
                (nearest, next) = ((off, row), nearest.0);
            } else {
                next = next.min(off);
            }
        }
        (nearest.0 < 0.4 * (nearest.0 + next)).then_some(nearest.1)
    }
}

/// Fewest lasers of a sensor whose rows are found by the order of its points.
const FEWEST_LASERS: usize = 8;

/// Least share of the returns of a scan on the cones of its lasers. A sensor's own points lie on them exactly; those of
/// a simulation that shoots from one point do not, and would spoil the table.
const ON_CONES: f64 = 0.98;

/// Elevations, from the lowest, rad, and heights, m, of rows whose rays do not start in one point, from those scans
/// that keep the order of the lasers; empty without such scans.
fn rows_of_lasers(scans: &[&SensorScan]) -> (Vec<f32>, Vec<f32>) {
    let cones_of = |scan: &&SensorScan| {
        let point = |i: usize| {
            let [range, elevation] = [scan.range_m[i], scan.elevation_rad[i]].map(f64::from);
            [range * elevation.cos(), range * elevation.sin(), f64::from(scan.azimuth_rad[i]), 0.0]
        };
        let cones = lasers::cones(&lasers::rings((0..scan.len()).map(point)));
        let on: f64 = cones.iter().map(lasers::Cone::points).sum();
        let found = cones.len() >= FEWEST_LASERS && on > ON_CONES * scan.len() as f64;
        if found { cones } else { vec![] }
    };
    let beams = lasers::beams(scans.iter().flat_map(cones_of).collect());
    beams.iter().rev().map(|beam| (beam.elevation_rad as f32, beam.height_m as f32)).unzip()
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
fn azimuth_step(scans: &[&SensorScan], rows: &[f32], heights_m: &[f32]) -> Option<f32> {
    if rows.len() < 4 {
        return None;
    }
    let pattern = ScanPattern { rows_rad: rows.to_vec(), heights_m: heights_m.to_vec(), ..ScanPattern::default() };
    let mut differences = Vec::new();
    for scan in scans {
        let mut by_row: Vec<Vec<f32>> = vec![Vec::new(); rows.len()];
        for i in 0..scan.len() {
            if let Some(row) = pattern.row(scan.elevation_rad[i], scan.range_m[i]) {
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
        assert_eq!(pattern.row(truth[7] + 1e-3, 10.0), Some(7));
        let beside = f64::from(pattern.steps.elevation_rad) / 2.0;
        for (end, out) in [(truth[0], -1.0), (truth[23], 1.0)] {
            let [inside, outside] = [0.9, 1.1].map(|share| pattern.reaches(f64::from(end) + out * share * beside));
            assert!(inside && !outside);
        }
    }

    /// Two blocks of lasers at heights of their own, as in an HDL-64E. Seen from the origin of the cloud the rows
    /// overlap; by range and elevation each return belongs to one.
    #[test]
    fn rows_of_lasers_with_origins_of_their_own_are_found_by_the_order_of_the_points() {
        let lasers: Vec<lasers::Beam> = (0..24)
            .map(|k| lasers::Beam {
                elevation_rad: (2.0 - 0.4 * f64::from(k)).to_radians(),
                height_m: if k < 12 { 0.2 } else { 0.12 },
            })
            .collect();
        // Walls of a room that is no circle, and the ground.
        let at = |laser: &lasers::Beam, azimuth: f64| {
            let wall_m = 6.0 + 9.0 * (1.5 * azimuth).sin().powi(2);
            let down = laser.direction(azimuth).z;
            if down < 0.0 { wall_m.min((1.7 + laser.height_m) / -down) } else { wall_m }
        };
        let (mut scan, mut of) = (SensorScan::default(), Vec::new());
        for (k, laser) in lasers.iter().enumerate() {
            for i in 0..900 {
                let azimuth = (0.1 + 0.4 * f64::from(i)).to_radians();
                let [az, el, range] = crate::rig::Sensor::spherical(&laser.point(azimuth, at(laser, azimuth)).into());
                scan.azimuth_rad.push(az as f32);
                scan.elevation_rad.push(el as f32);
                scan.range_m.push(range as f32);
                of.push(lasers.len() - 1 - k);
            }
        }
        // The simulated side shoots the same directions from one point, so that its points lie on no cone.
        let mut simulated = scan.clone();
        simulated.range_m.iter_mut().enumerate().for_each(|(i, m)| *m *= 1.0 + 0.03 * (i as f32).sin());
        let pattern = ScanPattern::of_scans(&[&scan, &simulated, &scan, &simulated]);
        assert_eq!((pattern.rows_rad.len(), pattern.heights_m.len()), (24, 24));
        for (row, laser) in lasers.iter().rev().enumerate() {
            assert!((f64::from(pattern.rows_rad[row]) - laser.elevation_rad).abs() < 1e-4, "row {row}");
            assert!((f64::from(pattern.heights_m[row]) - laser.height_m).abs() < 2e-3, "row {row}");
        }
        let row = |i: usize| pattern.row(scan.elevation_rad[i], scan.range_m[i]);
        let right = (0..scan.len()).filter(|i| row(*i) == Some(of[*i])).count();
        assert!(right as f64 > 0.95 * scan.len() as f64, "{right} of {}", scan.len());
        assert!((f64::from(pattern.steps.azimuth_rad) - 0.4f64.to_radians()).abs() < 1e-4);
    }

    #[test]
    fn a_real_sensor_of_two_blocks_has_its_64_rows() {
        let root = concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data/kitti/training/velodyne");
        let read = |name: &str| std::fs::read(std::path::Path::new(root).join(name));
        let (Ok(one), Ok(other)) = (read("000000.bin"), read("000001.bin")) else {
            eprintln!("not run: {root} is not there");
            return;
        };
        let scans = [one, other].map(|bytes| {
            let values = bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
            let cloud = data::Cloud { values, channels: 4 };
            super::super::split_by_sensor(&cloud, &crate::Rig::single()).remove(0)
        });
        let pattern = ScanPattern::of_scans(&scans.each_ref());
        assert_eq!(pattern.rows_rad.len(), 64);
        let [lower, upper] = [&pattern.heights_m[..32], &pattern.heights_m[32..]];
        assert!(lower.iter().all(|m| (0.10..0.14).contains(m)) && upper.iter().all(|m| (0.18..0.23).contains(m)));
        let known = |i: &usize| pattern.row(scans[0].elevation_rad[*i], scans[0].range_m[*i]).is_some();
        let share = (0..scans[0].len()).filter(known).count() as f64 / scans[0].len() as f64;
        assert!(share > 0.98, "{share}");
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
