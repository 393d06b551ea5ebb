//! The rows of a scan, and the shots of which no return is in the file.

use nalgebra::Vector3;
use sensor::directions::{SensorScan, Steps};
use sensor::rig;
use std::f32::consts::{FRAC_PI_2, PI, TAU};

/// Returns by row (laser), each in the order of azimuth.
#[derive(Clone, Debug, PartialEq)]
pub struct Rows(Vec<Vec<u32>>);

/// A shot of a scan, in the LiDAR frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shot {
    /// Unit vector.
    pub direction: [f32; 3],
    /// Number of its return among those of the scan; `None` for a shot without a return.
    pub measured: Option<u32>,
    /// Time relative to the stamp of the frame, s.
    pub time_s: f32,
}

/// Fewest rows, and fewest returns of a row.
const FEWEST: (usize, usize) = (8, 50);

/// Widest gap of a row that is filled with shots, rad: 60 degrees. Beyond, the sensor may not have looked.
const WIDEST_GAP_RAD: f32 = 1.05;

impl Rows {
    /// By the ring of each return.
    pub fn of_rings(returns: &SensorScan, ring: &[u16]) -> Option<Rows> {
        let mut rows = vec![Vec::new(); ring.iter().max().map_or(0, |r| usize::from(*r) + 1)];
        for (i, r) in ring.iter().enumerate() {
            rows[usize::from(*r)].push(i as u32);
        }
        Rows::of(returns, rows)
    }

    /// By the order of the file: lasers one after the other, each counter-clockwise. A row ends where the azimuth
    /// passes from below to above 0. `None` if the file has another order.
    pub fn of_order(returns: &SensorScan) -> Option<Rows> {
        let (mut rows, mut before, mut forward) = (vec![Vec::new()], 0.0f32, 0usize);
        for (i, azimuth) in returns.azimuth_rad.iter().enumerate() {
            if before < 0.0 && (0.0..FRAC_PI_2).contains(azimuth) {
                rows.push(Vec::new());
            }
            forward += usize::from((azimuth - before + PI).rem_euclid(TAU) > PI);
            before = *azimuth;
            rows.last_mut().expect("there is one").push(i as u32);
        }
        // A file in another order goes back and forth.
        (forward as f32 > 0.97 * returns.len() as f32).then(|| Rows::of(returns, rows))?
    }

    fn of(returns: &SensorScan, mut rows: Vec<Vec<u32>>) -> Option<Rows> {
        rows.retain(|row| row.len() >= FEWEST.1);
        for row in &mut rows {
            row.sort_by(|a, b| {
                returns.azimuth_rad[*a as usize].total_cmp(&returns.azimuth_rad[*b as usize]).then(a.cmp(b))
            });
        }
        (rows.len() >= FEWEST.0).then_some(Rows(rows))
    }

    /// Number of rows.
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// Whether there is no row.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Median elevation of each row, rad.
    pub fn elevations_rad(&self, returns: &SensorScan) -> Vec<f32> {
        let median = |row: &Vec<u32>| {
            let mut all: Vec<f32> = row.iter().map(|i| returns.elevation_rad[*i as usize]).collect();
            let middle = all.len() / 2;
            *all.select_nth_unstable_by(middle, f32::total_cmp).1
        };
        self.0.iter().map(median).collect()
    }

    /// Median step along the rows, and from row to row.
    pub fn steps(&self, returns: &SensorScan) -> Option<Steps> {
        let azimuth: Vec<f64> = self.0.iter().filter_map(|row| step(returns, row)).map(f64::from).collect();
        let mut elevations = self.elevations_rad(returns);
        elevations.sort_by(f32::total_cmp);
        let gaps: Vec<f64> = elevations.windows(2).map(|w| f64::from(w[1] - w[0])).filter(|gap| *gap > 1e-4).collect();
        Some(Steps {
            azimuth_rad: statistics::median_upper(azimuth)? as f32,
            elevation_rad: statistics::median_upper(gaps)? as f32,
        })
    }

    /// The shots between the returns of each row whose own returns are not in the file: where the distance to the next
    /// return of the row is more than a step and a half.
    pub fn lost_shots(&self, returns: &SensorScan, time_s: Option<&[f32]>) -> Vec<Shot> {
        let mut lost = Vec::new();
        for row in &self.0 {
            let Some(step) = step(returns, row) else { continue };
            let next = row.iter().skip(1).chain(row.first());
            for (a, b) in row.iter().zip(next) {
                let (a, b) = (*a as usize, *b as usize);
                let gap = (returns.azimuth_rad[b] - returns.azimuth_rad[a]).rem_euclid(TAU);
                if gap > WIDEST_GAP_RAD || gap < 1.5 * step {
                    continue;
                }
                let missing = (gap / step).round() as usize - 1;
                for k in 1..=missing {
                    let share = k as f32 / (missing + 1) as f32;
                    let between = |v: &[f32]| v[a] + share * (v[b] - v[a]);
                    let azimuth = returns.azimuth_rad[a] + share * gap;
                    let direction = rig::direction(f64::from(azimuth), f64::from(between(&returns.elevation_rad)));
                    lost.push(Shot {
                        direction: direction.map(|v| v as f32),
                        measured: None,
                        time_s: time_s.map_or(0.0, between),
                    });
                }
            }
        }
        lost
    }
}

/// Median distance of neighbours in a row, rad.
fn step(returns: &SensorScan, row: &[u32]) -> Option<f32> {
    let gaps = row.windows(2).map(|w| returns.azimuth_rad[w[1] as usize] - returns.azimuth_rad[w[0] as usize]);
    statistics::median_upper(gaps.filter(|gap| *gap > 1e-5).map(f64::from).collect::<Vec<_>>()).map(|v| v as f32)
}

/// The shots of a scan: those that returned, in the order of the file, then those that did not.
pub fn shots(scan: &super::RecordedScan) -> Vec<Shot> {
    let unit = |p: &[f32; 3]| Vector3::from(*p).normalize().into();
    let time = |i: usize| scan.time_s.as_ref().map_or(0.0, |t| t[i]);
    let measured = scan.points.iter().enumerate();
    let mut all: Vec<Shot> =
        measured.map(|(i, p)| Shot { direction: unit(p), measured: Some(i as u32), time_s: time(i) }).collect();
    if let Some(rows) = &scan.rows {
        all.extend(rows.lost_shots(&scan.returns, scan.time_s.as_deref()));
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 16 rows of 1 degree steps; `keep` says which shots return.
    fn scan(keep: impl Fn(usize, usize) -> bool) -> SensorScan {
        let mut scan = SensorScan::default();
        for row in 0..16 {
            for column in 0..360 {
                if keep(row, column) {
                    let azimuth = (column as f32 + 0.5).to_radians();
                    scan.azimuth_rad.push(if azimuth > PI { azimuth - TAU } else { azimuth });
                    scan.elevation_rad.push(0.1 - 0.01 * row as f32);
                    scan.range_m.push(10.0);
                }
            }
        }
        scan
    }

    #[test]
    fn rows_are_found_in_the_order_of_the_file() {
        let returns = scan(|_, _| true);
        let rows = Rows::of_order(&returns).unwrap();
        let steps = rows.steps(&returns).unwrap();
        assert_eq!(rows.len(), 16);
        assert!((steps.azimuth_rad - 1f32.to_radians()).abs() < 1e-4 && (steps.elevation_rad - 0.01).abs() < 1e-4);
        assert!(rows.lost_shots(&returns, None).is_empty());
        // Column by column there are no rows to be read off the order.
        let mut order: Vec<usize> = (0..returns.len()).collect();
        order.sort_by_key(|i| (i * 7919) % returns.len());
        let mixed = SensorScan {
            azimuth_rad: order.iter().map(|i| returns.azimuth_rad[*i]).collect(),
            elevation_rad: order.iter().map(|i| returns.elevation_rad[*i]).collect(),
            range_m: order.iter().map(|i| returns.range_m[*i]).collect(),
            intensity: vec![],
        };
        assert!(Rows::of_order(&mixed).is_none());
        let ring: Vec<u16> = order.iter().map(|i| (i / 360) as u16).collect();
        assert_eq!(Rows::of_rings(&mixed, &ring).unwrap().len(), 16);
    }

    #[test]
    fn shots_without_a_return_are_found_where_the_row_has_a_gap() {
        let lost = |row: usize, column: usize| row == 3 && [20, 21, 200].contains(&column);
        let returns = scan(|row, column| !lost(row, column));
        let found = Rows::of_order(&returns).unwrap().lost_shots(&returns, None);
        assert_eq!(found.len(), 3);
        for shot in found {
            let azimuth = shot.direction[1].atan2(shot.direction[0]).to_degrees().rem_euclid(360.0);
            assert!([20.5, 21.5, 200.5].iter().any(|c| (azimuth - c).abs() < 1e-3), "{azimuth}");
            assert!((shot.direction[2].asin() - 0.07).abs() < 1e-4);
        }
    }

    #[test]
    fn a_sector_that_is_never_looked_at_is_not_filled() {
        let returns = scan(|_, column| column < 250);
        assert!(Rows::of_order(&returns).unwrap().lost_shots(&returns, None).is_empty());
    }
}
