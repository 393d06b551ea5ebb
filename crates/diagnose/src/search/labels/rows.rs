//! Objects with their shifts and the covariates that may explain them.

use super::Side;
use crate::channels::labels::ObjectShift;
use crate::channels::mean::origins;
use crate::channels::motion::OwnMotion;
use crate::inference::linear::LinearFrame;
use crate::search::Context;
use crate::search::geometry::Displacement;
use nalgebra::{DMatrix, DVector, Vector3};
use sensor::Sensor;
use sensor::assignment::Assignment;

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
    /// Length: the visible one of front and rear is displaced by half of the difference.
    Longer,
    /// Width.
    Wider,
    /// Relative velocity times the phase of the scan.
    Swept,
}

/// All columns, in the order of their numbers.
pub(super) const COLUMNS: [Column; 8] = [
    Column::Forward,
    Column::Left,
    Column::Up,
    Column::SeenVelocity,
    Column::Velocity,
    Column::Longer,
    Column::Wider,
    Column::Swept,
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
    /// Along the axes of the object, m.
    pub(super) shift: [f64; 3],
    /// Variance of the shift, m2.
    pub(super) variance: [f64; 3],
    /// Derivatives by the columns, by axis.
    pub(super) x: [[f64; 8]; 3],
    /// Velocity over the ground along the heading, m/s.
    pub(super) speed: Option<f64>,
    /// Whether each column is known of this object.
    pub(super) known: [bool; 8],
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
            let (shift, error) = s.cloud_m?;
            (shift, error.map(|e| e * e))
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
    let mut x = [[0.0; 8]; 3];
    for (k, x) in x.iter_mut().enumerate() {
        x[k] = 1.0;
    }
    let mount = &context.rig.sensors[sensor];
    let motion = context.motion.as_deref().and_then(|m| m[s.frame]);
    let (speed, known) = velocity_columns(&mut x, s.seen_velocity_m_s, &center, mount, motion, axes);
    let towards = axes(-center / center.norm().max(1e-6));
    x[0][5] = towards[0];
    x[1][6] = towards[1];
    Some(Row {
        frame: s.frame,
        object: s.object,
        yaw_rad: object.yaw_rad,
        center: object.center,
        shift,
        variance,
        x,
        speed,
        known,
    })
}

/// Fills the columns of velocities. Returns the velocity over the ground along the heading, and which columns are
/// known.
fn velocity_columns(
    x: &mut [[f64; 8]; 3],
    seen: Option<[f64; 3]>,
    center: &Vector3<f64>,
    mount: &Sensor,
    motion: Option<OwnMotion>,
    axes: impl Fn(Vector3<f64>) -> [f64; 3],
) -> (Option<f64>, [bool; 8]) {
    let mut known = [true; 8];
    let Some(seen) = seen else {
        (known[3], known[4], known[7]) = (false, false, false);
        return (None, known);
    };
    (0..3).for_each(|k| x[k][3] = seen[k]);
    let [azimuth_rad, elevation_rad, _] = Sensor::spherical(&mount.pose().inverse_transform_point(&(*center).into()));
    let phase = mount.scan_phase(azimuth_rad, elevation_rad);
    (0..3).for_each(|k| x[k][7] = seen[k] * phase);
    let Some(own) = motion else {
        known[4] = false;
        return (None, known);
    };
    let carried = axes(own.velocity_at(center));
    (0..3).for_each(|k| x[k][4] = seen[k] + carried[k]);
    (Some(x[0][4]), known)
}

/// Leaves columns out that are not known of more than 60 % of the objects, then objects with an unknown column.
/// Returns which columns are used.
pub(super) fn keep_known(rows: &mut Vec<Row>) -> [bool; 8] {
    let share = |k: usize| rows.iter().filter(|r| r.known[k]).count() as f64 / rows.len() as f64;
    let usable: [bool; 8] = std::array::from_fn(|k| share(k) > 0.6);
    rows.retain(|r| (0..8).all(|k| r.known[k] || !usable[k]));
    rows.iter_mut().for_each(|r| r.x.iter_mut().for_each(|x| (0..8).filter(|&k| !usable[k]).for_each(|k| x[k] = 0.0)));
    usable
}

/// Sets the variances to the robust variance of the residuals of a fit of all columns, axis by axis.
pub(super) fn set_noise(rows: &mut [Row], select: &[usize], side: Side) {
    for axis in 0..3 {
        let mut gram = DMatrix::<f64>::identity(8, 8) * 1e-3;
        let mut right = DVector::<f64>::zeros(8);
        for r in rows.iter().filter(|r| select.contains(&r.frame)) {
            let x = DVector::from_row_slice(&r.x[axis]);
            let w = if side == Side::Labels { 1.0 } else { 1.0 / (r.variance[axis] + 0.05f64.powi(2)) };
            gram += &x * x.transpose() * w;
            right += &x * (w * r.shift[axis]);
        }
        let theta = gram.try_inverse().map_or_else(|| DVector::zeros(8), |inverse| inverse * right);
        let left: Vec<f64> = rows
            .iter()
            .filter(|r| select.contains(&r.frame))
            .filter(|r| side == Side::Labels || r.variance[axis] < 0.1)
            .map(|r| (r.shift[axis] - (0..8).map(|k| r.x[axis][k] * theta[k]).sum::<f64>()).abs())
            .collect();
        let scale = (statistics::median_upper(left).unwrap_or(0.1) / statistics::MEDIAN_OF_NORMAL).max(0.008);
        for r in rows.iter_mut() {
            r.variance[axis] = if side == Side::Labels { scale * scale } else { r.variance[axis] + scale * scale };
        }
    }
}

/// Linear sums of one frame over all columns.
pub(super) fn sums(rows: &[Row], frame: usize) -> LinearFrame {
    let mut out = LinearFrame { gram: DMatrix::zeros(8, 8), right: DVector::zeros(8) };
    for r in rows.iter().filter(|r| r.frame == frame) {
        for axis in 0..3 {
            let x = DVector::from_row_slice(&r.x[axis]);
            let w = r.robust(axis) / r.variance[axis];
            out.gram += &x * x.transpose() * w;
            out.right += &x * (w * r.shift[axis]);
        }
    }
    out
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
