//! Second returns of a shot: two ranges in one direction.

use sensor::directions::SensorScan;
use std::collections::BTreeSet;

/// Difference of direction below which two returns are of one shot, rad: the precision of single-precision coordinates
/// of near points. Neighbouring shots are a hundred times as far apart.
const ONE_SHOT_RAD: f32 = 3e-5;

/// Difference of range from which on two returns of one direction are two surfaces and no copy, m.
const APART_M: f32 = 0.1;

/// Removes the farther return of every shot that has two, so that both sides show one return a shot. Returns how many
/// were removed.
pub(super) fn drop_second(scan: &mut SensorScan) -> usize {
    let mut order: Vec<usize> = (0..scan.len()).collect();
    order.sort_by(|a, b| scan.azimuth_rad[*a].total_cmp(&scan.azimuth_rad[*b]));
    let mut second = BTreeSet::new();
    for (k, &i) in order.iter().enumerate() {
        for &j in order[k + 1..].iter().take_while(|j| scan.azimuth_rad[**j] - scan.azimuth_rad[i] < ONE_SHOT_RAD) {
            let apart_m = scan.range_m[i] - scan.range_m[j];
            if (scan.elevation_rad[i] - scan.elevation_rad[j]).abs() < ONE_SHOT_RAD && apart_m.abs() > APART_M {
                second.insert(if apart_m > 0.0 { i } else { j });
            }
        }
    }
    if !second.is_empty() {
        for column in [&mut scan.azimuth_rad, &mut scan.elevation_rad, &mut scan.range_m, &mut scan.intensity] {
            let mut at = 0..;
            column.retain(|_| at.next().is_none_or(|i| !second.contains(&i)));
        }
    }
    second.len()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_farther_return_of_a_direction_goes_and_copies_and_neighbours_stay() {
        let mut scan = SensorScan {
            azimuth_rad: vec![0.5, 0.1, 0.5, 0.502, 0.1, 0.5],
            elevation_rad: vec![0.0, -0.1, 0.0, 0.0, -0.1, 0.02],
            range_m: vec![30.0, 7.0, 12.0, 12.0, 7.0, 12.0],
            intensity: vec![0.0, 1.0, 2.0, 3.0, 4.0, 5.0],
        };
        assert_eq!(drop_second(&mut scan), 1);
        assert_eq!(scan.range_m, [7.0, 12.0, 12.0, 7.0, 12.0]);
        assert_eq!(scan.intensity, [1.0, 2.0, 3.0, 4.0, 5.0]);
    }
}
