//! The smallest effects of geometry that are reported.

use super::hypotheses::Hypothesis;
use super::sums::{Sums, group_fit};
use crate::catalogue::Cause;
use crate::catalogue::sizes::{
    DISPLACED_M, FAR_RANGE_OFFSET_M, RANGE_OFFSET_M, ROWS_ELEVATION_RAD, ROWS_RANGE_M, SHIFT_M, STEPS_RANGE_M,
    STRIPS_RANGE_M, SWEEP_M, SWEEP_RAD, TURN_RAD,
};
use crate::channels::groups::{Grouping, total};
use crate::channels::mean::Column;
use crate::channels::moments::COURSES;
use crate::inference::grouped;
use crate::inference::linear::LinearFit;
use nalgebra::{DMatrix, DVector};

/// Smallest displacement over a scan that is reported: along x and y, m; about z, rad.
pub(super) const FLOOR_SWEEP: [f64; 3] = [SWEEP_M, SWEEP_M, SWEEP_RAD];

/// Smallest spread of group offsets that is reported: rows in range, m; rows in elevation, rad; strips of azimuth in
/// range, m; steps of range, m.
pub(super) const FLOOR_GROUPS: [f64; 4] = [ROWS_RANGE_M, ROWS_ELEVATION_RAD, STRIPS_RANGE_M, STEPS_RANGE_M];

/// Steps of range to either side that an offset by range is compared with, 2 m: a bias and a scale are alike there.
const STEPS_BESIDE: u16 = 8;

/// Whether the effect of the last of some hypotheses, fitted together, is large enough to be reported.
pub(super) fn above_floor(sums: &Sums, select: &[usize], blocks: &[usize], hypotheses: &[Hypothesis]) -> bool {
    let Some(last) = hypotheses.last() else { return false };
    match last {
        Hypothesis::Groups { grouping, column, .. } => {
            let frames = sums.groups_of(*grouping);
            let all = total(select.iter().map(|&i| &frames[i]));
            match grouping {
                Grouping::Row => {
                    let offsets = sums.offsets(select, *grouping, group_fit(*column), hypotheses);
                    grouped::rough_spread(&all, &offsets, group_fit(*column)) > FLOOR_GROUPS[*column]
                }
                Grouping::Azimuth => grouped::spread(&all, group_fit(*column), 0.0).0 > FLOOR_GROUPS[2],
                Grouping::Range => {
                    let offsets = sums.offsets(select, *grouping, group_fit(*column), hypotheses);
                    grouped::spread_about(&all, &offsets, group_fit(*column), STEPS_BESIDE) > FLOOR_GROUPS[3]
                }
            }
        }
        Hypothesis::Linear { columns, .. } => {
            let fitted = sums.fit_all(select, blocks, hypotheses);
            let own = fitted.columns.iter().zip(fitted.theta.iter()).filter(|(c, _)| columns.contains(c));
            let coefficients: Vec<(usize, f64)> = own.map(|(c, t)| (*c, *t)).collect();
            let sensor_of = |c: &usize| if let Column::SensorPose(s, _) = sums.columns[*c] { Some(s) } else { None };
            let sensor = columns.iter().find_map(sensor_of);
            let others: Vec<usize> = fitted.columns.iter().filter(|c| !columns.contains(c)).copied().collect();
            if sums.displaced_m(select, sensor, &coefficients, &others) < DISPLACED_M {
                return false;
            }
            if sensor.is_some() {
                return true;
            }
            let of =
                |column: Column| coefficients.iter().find(|(c, _)| sums.columns[*c] == column).map_or(0.0, |(_, t)| *t);
            let drift_m: f64 = (0..COURSES).map(|k| of(Column::Drift(k))).sum();
            let bias_m = |range_m: f64| (of(Column::RangeOffset) + range_m * of(Column::RangeScale) + drift_m).abs();
            bias_m(10.0) > RANGE_OFFSET_M
                || bias_m(40.0) > FAR_RANGE_OFFSET_M
                || coefficients.iter().any(|(c, t)| t.abs() > sums.smallest(*c))
        }
    }
}

/// Columns of the last of some hypotheses, fitted together, that are large enough to be reported by themselves.
pub(super) fn sizable(sums: &Sums, frames: &[usize], blocks: &[usize], hypotheses: &[Hypothesis]) -> Vec<Column> {
    let own = hypotheses.last().map_or(&[][..], Hypothesis::columns);
    let fitted = sums.fit_all(frames, blocks, hypotheses);
    let all = fitted.columns.iter().zip(fitted.theta.iter());
    all.filter(|(c, theta)| own.contains(c) && theta.abs() >= sums.smallest(**c))
        .map(|(c, _)| sums.columns[*c])
        .collect()
}

/// Whether a hypothesis is a pose of the only sensor of which nothing but roll and pitch is large enough to be reported
/// and differs from zero: the ego vehicle may have that attitude.
pub(super) fn is_attitude_alone(sums: &Sums, fitted: &LinearFit, hypothesis: &Hypothesis) -> bool {
    let Hypothesis::Linear { cause: Cause::SensorExtrinsics, columns } = hypothesis else { return false };
    let is_sizable = |column: usize| {
        let of = sums.fitted(fitted, sums.columns[column]);
        of.is_some_and(|[value, error]| value.abs() >= sums.smallest(column).max(1.96 * error))
    };
    columns.iter().all(|&c| match sums.columns[c] {
        Column::Pose(0 | 1) => true,
        Column::Pose(_) => !is_sizable(c),
        _ => false,
    })
}

impl Sums {
    /// Smallest coefficient of a column that is reported for itself.
    fn smallest(&self, column: usize) -> f64 {
        match self.columns[column] {
            Column::Pose(0..3) => TURN_RAD,
            Column::Pose(_) => SHIFT_M,
            Column::Sweep(k) => FLOOR_SWEEP[k],
            Column::Scan => FLOOR_SWEEP[0] / self.moments.middle_m_s().max(1e-9),
            Column::Lean => TURN_RAD / self.moments.most_lean().max(1e-9),
            Column::RangeOffset
            | Column::RangeScale
            | Column::Drift(_)
            | Column::SensorPose(..)
            | Column::Structure(_)
            | Column::Uneven => f64::INFINITY,
        }
    }

    /// Coefficients of some other columns that take up what they can of an effect; `response` is the product of `gram`
    /// with the effect.
    pub(super) fn taken_up(&self, gram: &DMatrix<f64>, response: &DVector<f64>, others: &[usize]) -> DVector<f64> {
        let prior = |i: usize, j: usize| if i == j { self.precision[others[i]] } else { 0.0 };
        let n = others.len();
        let own = DMatrix::from_fn(n, n, |i, j| gram[(others[i], others[j])] + prior(i, j));
        let on_others = DVector::from_fn(n, |i, _| response[others[i]]);
        own.cholesky().map_or_else(|| DVector::zeros(n), |own| own.solve(&on_others))
    }

    /// Displacement of the surfaces that a sensor sees, or all sensors, by some columns, m, root mean square. The part
    /// that `others` of the columns absorb is subtracted; of what one sensor sees, also the part that the ego pose of a
    /// single frame is.
    pub(super) fn displaced_m(
        &self,
        frames: &[usize],
        sensor: Option<usize>,
        coefficients: &[(usize, f64)],
        others: &[usize],
    ) -> f64 {
        let of_frame = |f: usize| if sensor.is_some() { &self.linear[f].gram } else { &self.whole[f].gram };
        let gram: DMatrix<f64> = frames.iter().map(|&f| of_frame(f)).sum();
        let mut by = DVector::zeros(self.columns.len());
        coefficients.iter().for_each(|(c, x)| by[*c] = *x);
        let response = &gram * &by;
        let taken_up = self.taken_up(&gram, &response, others);
        let absorbed: f64 = others.iter().zip(taken_up.iter()).map(|(&c, by)| response[c] * by).sum();
        let of_frame = |f: &usize| match sensor {
            Some(sensor) => self.of_sensors[*f][sensor],
            None => self.of_sensors[*f].iter().sum(),
        };
        let weights: f64 = frames.iter().map(of_frame).sum();
        ((by.dot(&response) - absorbed).max(0.0) / weights.max(1e-12)).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::super::sums::Groups;
    use super::*;
    use crate::channels::mean::MeanFrame;
    use crate::channels::moments::Moments;
    use crate::inference::linear::LinearFrame;
    use nalgebra::SVector;

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
            whole: vec![MeanFrame { gram: gram.clone(), right: DVector::zeros(4) }],
            own_prior: SVector::zeros(),
            undone: DVector::zeros(4),
            undone_rows: Default::default(),
            noise_m: 0.01,
            design: 1.0,
            linear: vec![LinearFrame { gram, right: DVector::zeros(4) }],
            rows: vec![],
            of_patches: 1.0,
            whole_rows: vec![],
            parted_rows: [vec![], vec![]],
            rows_with_pose: [vec![], vec![]],
            strips: none(),
            steps: none(),
            poses: vec![],
            of_sensors: vec![vec![2e6]],
            moments: Moments::default(),
        }
    }

    #[test]
    fn a_displaced_wall_absorbs_the_shift_of_the_only_sensor_that_sees_it() {
        let sums = sums();
        // 2500 of 1e6 are not absorbed: 5 % of the shift, in half of the returns.
        let across = sums.displaced_m(&[0], Some(0), &[(2, 0.02)], &[0, 1]);
        assert!((across - 0.02 * 0.05 / 2f64.sqrt()).abs() < 1e-5, "{across}");
        assert!((sums.displaced_m(&[0], None, &[(2, 0.02)], &[]) - 0.02 / 2f64.sqrt()).abs() < 1e-9);
    }

    #[test]
    fn a_pose_of_the_only_sensor_without_yaw_and_shift_may_be_an_attitude() {
        let alone = |[pitch, yaw, ahead_m]: [f64; 3], variance: f64| {
            let gram = DMatrix::identity(3, 3) * 1e6;
            let linear = LinearFrame { right: &gram * DVector::from_row_slice(&[pitch, yaw, ahead_m]), gram };
            let columns = vec![Column::Pose(1), Column::Pose(2), Column::Pose(3)];
            let sums = Sums { columns, precision: vec![25.0; 3], base: vec![], linear: vec![linear], ..sums() };
            let pose = |cause| Hypothesis::Linear { cause, columns: vec![0, 1, 2] };
            let mut fitted = sums.fit_all(&[0], &[0], &[pose(Cause::SensorExtrinsics)]);
            fitted.covariance *= variance;
            assert!(!is_attitude_alone(&sums, &fitted, &pose(Cause::RangeBias)));
            is_attitude_alone(&sums, &fitted, &pose(Cause::SensorExtrinsics))
        };
        assert!(alone([5e-3, 2e-4, 0.02], 1.0));
        assert!(!alone([5e-3, 3e-3, 0.02], 1.0) && !alone([5e-3, 2e-4, 0.06], 1.0));
        // A shift of 6 cm with an error of 4 cm.
        assert!(alone([5e-3, 2e-4, 0.06], 1600.0));
    }
}
