//! Objects with their shifts and the covariates that may explain them.

use super::{NO_PRIOR, Side};
use crate::channels::labels::ObjectShift;
use crate::channels::mean::origins;
use crate::inference::linear::{LinearFrame, fit};
use crate::search::Context;
use crate::search::geometry::Displacement;
use nalgebra::{DMatrix, DVector, Vector3};
use sensor::Sensor;
use sensor::assignment::Assignment;
use std::collections::BTreeMap;

/// A linear effect on the shift of an object, in the object's own frame: one column of the fit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Column {
    Forward,
    Left,
    Up,
    /// Velocity relative to the ego vehicle, m/s: all positions are late against the cloud.
    SeenVelocity,
    /// Velocity over the ground, m/s: positions of the objects are late.
    Velocity,
    /// Length: surfaces grow from the middle of the object, so that the visible one of front and rear is displaced by
    /// half of the difference.
    Longer,
    /// Width.
    Wider,
    /// Height: surfaces grow from the ground.
    Higher,
    /// Relative velocity times the phase of the scan.
    Swept,
    /// Ahead along the heading of the ego vehicle: the ego speed, where it is not known, times the error of a clock.
    Ahead,
}

/// Number of columns.
pub(super) const ALL: usize = COLUMNS.len();

/// Number of [`Column::Ahead`].
pub(super) const AHEAD: usize = 8;

/// Number of [`Column::Higher`].
pub(super) const HIGHER: usize = 9;

/// All columns, in the order of their numbers.
pub(super) const COLUMNS: [Column; 10] = [
    Column::Forward,
    Column::Left,
    Column::Up,
    Column::SeenVelocity,
    Column::Velocity,
    Column::Longer,
    Column::Wider,
    Column::Swept,
    Column::Ahead,
    Column::Higher,
];

/// Largest shift of an object that is used, m.
const LARGEST_M: f64 = 3.0;

/// The shift of one object with its covariates.
pub(super) struct Row {
    /// Number of the frame.
    pub(super) frame: usize,
    /// Number of the object in the frame.
    pub(super) object: usize,
    pub(super) yaw_rad: f64,
    pub(super) center: [f64; 3],
    /// Size, mm: the same vehicle has the same one in all frames, and mostly another one than others.
    pub(super) size_mm: [i64; 3],
    /// Along the axes of the object, m.
    pub(super) shift: [f64; 3],
    /// Variance of the shift, m2.
    pub(super) variance: [f64; 3],
    /// Derivatives by the columns, by axis.
    pub(super) x: [[f64; ALL]; 3],
    /// Velocity over the ground along the heading, m/s.
    pub(super) speed: Option<f64>,
    /// Whether each column is known of this object.
    pub(super) known: [bool; ALL],
}

impl Row {
    /// Shift along an axis that coefficients of some columns cause, m.
    pub(super) fn expected<'a>(
        &self,
        axis: usize,
        columns: &[usize],
        coefficients: impl IntoIterator<Item = &'a f64>,
    ) -> f64 {
        columns.iter().zip(coefficients).map(|(&c, t)| self.x[axis][c] * t).sum::<f64>()
    }

    /// Shift along an axis that coefficients of all columns leave, m.
    fn residual(&self, axis: usize, theta: &DVector<f64>) -> f64 {
        self.shift[axis] - (0..ALL).map(|k| self.x[axis][k] * theta[k]).sum::<f64>()
    }

    /// Weight of a shift along an axis: shifts beyond 2 m and six standard deviations count less.
    fn robust(&self, axis: usize) -> f64 {
        let u = self.shift[axis].abs() / (2.0 + 6.0 * self.variance[axis].sqrt());
        if u < 1.0 { 1.0 } else { 1.0 / u }
    }
}

/// The row of one object; `None` where its shift is not known or too large.
pub(super) fn row(context: &Context, s: &ObjectShift, side: Side, displaced: &Displacement) -> Option<Row> {
    let (mut shift, variance) = match side {
        Side::Labels => (s.label_m, [1.0; 3]),
        Side::Objects => {
            let cloud = s.cloud?;
            (cloud.shift_m, cloud.error_m.map(|e| e * e))
        }
    };
    let object = context.frames[s.frame].objects[s.object].simulated?;
    let (sin, cos) = object.yaw_rad.sin_cos();
    let axes = |v: Vector3<f64>| [v.x * cos + v.y * sin, -v.x * sin + v.y * cos, v.z];
    let center = Vector3::from(object.center);
    let sensor = Assignment::new(context.rig).of_point(center.into()).map_or(0, |assigned| assigned.sensor);
    if side == Side::Objects {
        let origin = origins(context.rig)[sensor];
        let known = axes(displaced.of_point(&center, (s.frame, sensor), &origin));
        (0..3).for_each(|k| shift[k] -= known[k]);
    }
    if shift.iter().any(|v| v.abs() > LARGEST_M) {
        return None;
    }
    let mut x = [[0.0; ALL]; 3];
    for (k, x) in x.iter_mut().enumerate() {
        x[k] = 1.0;
    }
    let mount = &context.rig.sensors[sensor];
    let known = velocity_columns(&mut x, s, &center, mount);
    match s.cloud.filter(|_| side == Side::Objects) {
        Some(cloud) => {
            for (column, by) in [5, 6, HIGHER].into_iter().zip(cloud.by_size) {
                (0..3).for_each(|k| x[k][column] = by[k]);
            }
        }
        // A label of another size has its visible sides where they are seen.
        None => {
            let towards = axes(-center / center.norm().max(1e-6));
            (x[0][5], x[1][6]) = (towards[0], towards[1]);
        }
    }
    let ahead = axes(Vector3::x());
    (0..3).for_each(|k| x[k][AHEAD] = ahead[k]);
    Some(Row {
        frame: s.frame,
        object: s.object,
        yaw_rad: object.yaw_rad,
        center: object.center,
        size_mm: object.size.map(|m| (1e3 * m).round() as i64),
        shift,
        variance,
        x,
        speed: s.speed_m_s,
        known,
    })
}

/// Fills the columns of velocities. Returns which columns are known.
fn velocity_columns(x: &mut [[f64; ALL]; 3], s: &ObjectShift, center: &Vector3<f64>, mount: &Sensor) -> [bool; ALL] {
    let mut known = [true; ALL];
    let Some(seen) = s.seen_velocity_m_s else {
        (known[3], known[4], known[7]) = (false, false, false);
        return known;
    };
    let [azimuth_rad, elevation_rad, _] = Sensor::spherical(&mount.pose().inverse_transform_point(&(*center).into()));
    let phase = mount.scan_phase(azimuth_rad, elevation_rad);
    (0..3).for_each(|k| (x[k][3], x[k][7]) = (seen[k], seen[k] * phase));
    // Vehicles move along their heading.
    x[0][4] = s.speed_m_s.unwrap_or(0.0);
    known[4] = s.speed_m_s.is_some();
    known
}

/// Leaves columns out that are not known of more than 60 % of the objects, then objects with an unknown column.
/// Returns which columns are used.
pub(super) fn keep_known(rows: &mut Vec<Row>) -> [bool; ALL] {
    let share = |k: usize| rows.iter().filter(|r| r.known[k]).count() as f64 / rows.len() as f64;
    let usable: [bool; ALL] = std::array::from_fn(|k| share(k) > 0.6);
    rows.retain(|r| (0..ALL).all(|k| r.known[k] || !usable[k]));
    rows.iter_mut()
        .for_each(|r| r.x.iter_mut().for_each(|x| (0..ALL).filter(|&k| !usable[k]).for_each(|k| x[k] = 0.0)));
    usable
}

/// Rounds of the robust fit.
const ROUNDS: usize = 25;

/// Residual from which on a row counts less: in standard deviations, and beyond these, m. Velocities of other objects
/// are off by metres per second, which a clock turns into decimetres.
const OUTLYING: (f64, f64) = (3.0, 0.1);

/// Sets the variances to the robust variance of the residuals of a fit of all columns, axis by axis; larger where the
/// residual is [`OUTLYING`]: among the velocities are some of other objects.
pub(super) fn set_noise(rows: &mut [Row], select: &[usize], side: Side) {
    for axis in 0..3 {
        let (theta, scale) = robust_fit(rows, select, side, axis);
        for r in rows.iter_mut() {
            let variance = if side == Side::Labels { scale * scale } else { r.variance[axis] + scale * scale };
            let residual = r.residual(axis, &theta).abs() / (OUTLYING.0 * variance.sqrt() + OUTLYING.1);
            r.variance[axis] = variance * residual.max(1.0).powi(2);
        }
    }
}

/// Coefficients of all columns along an axis, and the standard deviation of what is left of the selecting frames'
/// objects, m. Residuals count as if they had a Cauchy distribution.
fn robust_fit(rows: &[Row], select: &[usize], side: Side, axis: usize) -> (DVector<f64>, f64) {
    let error = |r: &Row| if side == Side::Labels { 0.0 } else { r.variance[axis].sqrt() };
    let used: Vec<&Row> = rows.iter().filter(|r| select.contains(&r.frame)).collect();
    let (mut theta, mut scale) = (DVector::zeros(ALL), None);
    for _ in 0..ROUNDS {
        let mut gram = DMatrix::<f64>::identity(ALL, ALL) * 1e-3;
        let mut right = DVector::<f64>::zeros(ALL);
        for r in &used {
            let x = DVector::from_row_slice(&r.x[axis]);
            let own = if side == Side::Labels { 1.0 } else { 1.0 / (r.variance[axis] + 0.05f64.powi(2)) };
            let unlike =
                scale.map_or(0.0, |scale: f64| r.residual(axis, &theta) / (2.0 * scale.hypot(error(r)) + OUTLYING.1));
            let w = own / (1.0 + unlike * unlike);
            gram += &x * x.transpose() * w;
            right += &x * (w * r.shift[axis]);
        }
        theta = gram.try_inverse().map_or_else(|| DVector::zeros(ALL), |inverse| inverse * right);
        let sharp = used.iter().filter(|r| side == Side::Labels || r.variance[axis] < 0.1);
        let left: Vec<f64> = sharp.map(|r| r.residual(axis, &theta).abs()).collect();
        let robust = statistics::median_upper(left).unwrap_or(0.1) / statistics::MEDIAN_OF_NORMAL;
        scale = Some(robust.max(0.008));
    }
    (theta, scale.unwrap_or(0.1))
}

/// Linear sums of one frame over all columns.
pub(super) fn sums(rows: &[Row], frame: usize) -> LinearFrame {
    sums_of(rows.iter().filter(|r| r.frame == frame))
}

/// Linear sums of some objects over all columns.
fn sums_of<'a>(rows: impl Iterator<Item = &'a Row>) -> LinearFrame {
    let mut out = LinearFrame { gram: DMatrix::zeros(ALL, ALL), right: DVector::zeros(ALL) };
    for r in rows {
        for axis in 0..3 {
            let x = DVector::from_row_slice(&r.x[axis]);
            let w = r.robust(axis) / r.variance[axis];
            out.gram += &x * x.transpose() * w;
            out.right += &x * (w * r.shift[axis]);
        }
    }
    out
}

/// Fewest vehicles over which the scatter of shifts is known.
const FEWEST_VEHICLES: usize = 4;

/// Standard errors of coefficients by the scatter over the vehicles of some frames; zero with too few of them. A label
/// may be beside its vehicle in all frames alike: more frames do not tell it better.
pub(super) fn errors_by_vehicle(rows: &[Row], frames: &[usize], columns: &[usize]) -> Vec<f64> {
    let mut vehicles = BTreeMap::<[i64; 3], Vec<&Row>>::new();
    rows.iter().filter(|r| frames.contains(&r.frame)).for_each(|r| vehicles.entry(r.size_mm).or_default().push(r));
    if vehicles.len() < FEWEST_VEHICLES {
        return vec![0.0; columns.len()];
    }
    let sums: Vec<LinearFrame> = vehicles.values().map(|rows| sums_of(rows.iter().copied())).collect();
    let each: Vec<usize> = (0..sums.len()).collect();
    let fitted = fit(&sums.iter().collect::<Vec<_>>(), &each, columns, &NO_PRIOR);
    (0..columns.len()).map(|i| fitted.error(i)).collect()
}

/// Displacement of objects by coefficients of some columns, root mean square, m.
pub(super) fn displacement_m(rows: &[Row], columns: &[usize], coefficients: &[f64]) -> f64 {
    let square = |r: &Row| (0..3).map(|axis| r.expected(axis, columns, coefficients).powi(2)).sum::<f64>();
    let squares: f64 = rows.iter().map(square).sum();
    (squares / rows.len().max(1) as f64).sqrt()
}

/// Half the sum of the squared shifts of a frame in units of their variance, nats.
pub(super) fn distance(rows: &[Row], frame: usize) -> f64 {
    let of = |r: &Row| (0..3).map(|axis| 0.5 * r.robust(axis) / r.variance[axis] * r.shift[axis].powi(2)).sum::<f64>();
    rows.iter().filter(|r| r.frame == frame).map(of).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_that_are_beside_their_vehicles_in_all_frames_count_once_for_each_vehicle() {
        // Eight vehicles in 50 frames, each label 5 cm ahead of its vehicle or behind it.
        let row = |frame: usize, vehicle: usize| {
            let mut x = [[0.0; ALL]; 3];
            x[0][0] = 1.0;
            Row {
                frame,
                object: vehicle,
                yaw_rad: 0.0,
                center: [20.0, 0.0, 0.0],
                size_mm: [4000 + vehicle as i64, 1800, 1500],
                shift: [0.3 + 0.05 * if vehicle.is_multiple_of(2) { 1.0 } else { -1.0 }, 0.0, 0.0],
                variance: [0.05 * 0.05; 3],
                x,
                speed: None,
                known: [true; ALL],
            }
        };
        let rows_of = |n: usize| (0..50).flat_map(|f| (0..n).map(move |v| row(f, v))).collect::<Vec<_>>();
        let frames: Vec<usize> = (0..50).collect();
        let [error] = errors_by_vehicle(&rows_of(8), &frames, &[0])[..] else { panic!() };
        assert!((error / (0.05 / 8f64.sqrt()) - 1.0).abs() < 0.15, "{error}");
        assert_eq!(errors_by_vehicle(&rows_of(3), &frames, &[0]), [0.0]);
    }
}
