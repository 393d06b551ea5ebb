//! What is too small to speak of.

use super::hypotheses::Suspect;
use super::{Sums, fit_all, groups_of, how};
use crate::channels::groups::{Grouping, total};
use crate::channels::mean::Column;
use crate::inference::grouped;
use nalgebra::{DMatrix, DVector};

/// Smaller offsets of range are not spoken of, m; nor turns, rad; nor shifts, m.
pub(super) const FLOOR_OFFSET_M: f64 = 0.012;
pub(super) const FLOOR_TURN_RAD: f64 = 5.2e-4;
const FLOOR_SHIFT_M: f64 = 0.04;
/// Slower slides over a scan are not spoken of: m, m, rad.
const FLOOR_SWEEP: [f64; 3] = [0.3, 0.3, 0.01];
/// Poses of one sensor that displace the surfaces that it sees by less are not spoken of, m: root of the mean square. Its six numbers take up what is wrong
/// with the few surfaces that it alone sees.
pub(super) const FLOOR_SENSOR_M: f64 = 0.004;
/// Spread of offsets of groups below which nothing is said: rows, m and rad; strips of azimuth, m.
pub(super) const FLOOR_GROUPS: [f64; 3] = [0.006, 2.6e-4, 0.02];

/// Whether the last of some suspects is worth speaking of.
pub(super) fn above_floor(sums: &Sums, select: &[usize], blocks: &[usize], suspects: &[Suspect]) -> bool {
    let Some(last) = suspects.last() else { return false };
    match last {
        Suspect::Groups { grouping, column, .. } => {
            let frames = groups_of(sums, *grouping);
            let all = total(select.iter().map(|&i| &frames[i]));
            match grouping {
                Grouping::Row => grouped::rough_spread(&all, how(*column)) > FLOOR_GROUPS[*column],
                Grouping::Azimuth => grouped::spread(&all, how(*column), 0.0).0 > FLOOR_GROUPS[2],
            }
        }
        Suspect::Linear { columns, .. } => {
            let fitted = fit_all(sums, select, blocks, suspects);
            let told = fitted.columns.iter().zip(fitted.theta.iter()).filter(|(c, _)| columns.contains(c));
            let told: Vec<(usize, f64)> = told.map(|(c, t)| (*c, *t)).collect();
            let own = |c: &usize| if let Column::SensorPose(s, _) = sums.columns[*c] { Some(s) } else { None };
            if let Some(sensor) = columns.iter().find_map(own) {
                return sums.displaced_m(select, sensor, &told) > FLOOR_SENSOR_M;
            }
            let of = |column: Column| told.iter().find(|(c, _)| sums.columns[*c] == column).map_or(0.0, |(_, t)| *t);
            let bias_m = |range_m: f64| (of(Column::RangeOffset) + range_m * of(Column::RangeScale)).abs();
            let floor = |c: usize| match sums.columns[c] {
                Column::Pose(0..3) => FLOOR_TURN_RAD,
                Column::Pose(_) => FLOOR_SHIFT_M,
                Column::Sweep(k) => FLOOR_SWEEP[k],
                Column::RangeOffset | Column::RangeScale | Column::SensorPose(..) | Column::Structure(_) => {
                    f64::INFINITY
                }
            };
            bias_m(10.0) > FLOOR_OFFSET_M
                || bias_m(40.0) > 3.2 * FLOOR_OFFSET_M
                || told.iter().any(|(c, t)| t.abs() > floor(*c))
        }
    }
}

impl Sums {
    /// By how much coefficients of some columns displace the surfaces that a sensor sees beyond what every frame's own pose and surfaces that lie a little
    /// elsewhere take up, m: root of the mean square.
    pub(super) fn displaced_m(&self, frames: &[usize], sensor: usize, coefficients: &[(usize, f64)]) -> f64 {
        let gram: DMatrix<f64> = frames.iter().map(|&f| &self.linear[f].gram).sum();
        let mut by = DVector::zeros(self.columns.len());
        coefficients.iter().for_each(|(c, x)| by[*c] = *x);
        let push = &gram * &by;
        let prior = |i: usize, j: usize| if i == j { self.precision[self.base[i]] } else { 0.0 };
        let n = self.base.len();
        let structure = DMatrix::from_fn(n, n, |i, j| gram[(self.base[i], self.base[j])] + prior(i, j));
        let pushed = DVector::from_fn(n, |i, _| push[self.base[i]]);
        let taken_up = structure.cholesky().map_or(0.0, |c| pushed.dot(&c.solve(&pushed)));
        let weights: f64 = frames.iter().map(|&f| self.of_sensors[f][sensor]).sum();
        ((by.dot(&push) - taken_up).max(0.0) / weights.max(1e-12)).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::super::Groups;
    use super::*;
    use crate::inference::linear::LinearFrame;

    /// One sensor that sees ground and, in half of its returns, a wall; its shift along the wall's normal, and up.
    fn sums() -> Sums {
        let columns =
            vec![Column::Structure(0), Column::Structure(1), Column::SensorPose(0, 4), Column::SensorPose(0, 5)];
        // Levers: ground moves by the shift up, the wall by the one across.
        let levers = [[1.0, 0.0, 0.0, 1.0], [0.0, 1.0, 1.0, 0.0]];
        let mut gram = DMatrix::zeros(4, 4);
        for x in levers {
            let x = DVector::from_row_slice(&x);
            gram += 1e6 * &x * x.transpose();
        }
        let none = || Groups { parted: vec![], whole: vec![] };
        Sums {
            columns,
            precision: vec![2500.0, 2500.0, 25.0, 25.0],
            base: vec![0, 1],
            linear: vec![LinearFrame { gram, right: DVector::zeros(4) }],
            rows: none(),
            strips: none(),
            poses: vec![],
            of_sensors: vec![vec![2e6]],
        }
    }

    #[test]
    fn a_wall_that_lies_elsewhere_takes_up_what_the_only_sensor_that_sees_it_is_shifted_by() {
        let sums = sums();
        // 2500 of 1e6 are not taken up: 5 % of the shift, in half of the returns.
        let across = sums.displaced_m(&[0], 0, &[(2, 0.02)]);
        assert!((across - 0.02 * 0.05 / 2f64.sqrt()).abs() < 1e-5, "{across}");
        let free = Sums { base: vec![], ..sums };
        assert!((free.displaced_m(&[0], 0, &[(2, 0.02)]) - 0.02 / 2f64.sqrt()).abs() < 1e-9);
    }
}
