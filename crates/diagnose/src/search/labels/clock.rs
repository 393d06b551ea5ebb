//! A constant offset of labels, or a late clock? The dependence on the velocity that the own car sees.

use super::rows::Row;
use crate::channels::motion::OwnMotion;
use crate::inference::linear::{LinearFrame, fit};
use crate::inference::median;
use nalgebra::{DMatrix, DVector};

/// What the own speed may be, m/s: from the scene, or anything that a car does.
pub(super) fn own_speeds(motion: Option<&[Option<OwnMotion>]>) -> [f64; 2] {
    match median(motion.into_iter().flatten().flatten().map(|m| m.speed_m_s).collect()) {
        v if v > 5.0 => [0.7 * v, 1.4 * v],
        _ => [4.0, 90.0],
    }
}

/// Whether an offset that is the same for all could as well be a late clock: the dependence on the seen velocity that this would make is
/// not excluded.
pub(super) fn late(forward_m: f64, [slope, error]: [f64; 2], speeds: [f64; 2]) -> bool {
    let ends = speeds.map(|v| forward_m / v);
    slope + 2.5 * error > ends[0].min(ends[1]) && slope - 2.5 * error < ends[0].max(ends[1])
}

/// Whether an offset that is the same for all is a late clock for sure: shifts depend on the seen velocity, and an own speed that a car may have
/// makes the constant.
pub(super) fn surely_late(forward_m: f64, [slope, error]: [f64; 2], speeds: [f64; 2]) -> bool {
    slope.abs() > 3.2 * error && (speeds[0]..speeds[1]).contains(&(forward_m / slope))
}

/// Shift forward at no seen velocity of an object that heads as the own car does, m; of one that comes towards it a late clock makes the opposite.
pub(super) fn forward(rows: &[Row], slope: f64) -> f64 {
    let sum = |f: &dyn Fn(&Row, f64) -> f64| rows.iter().map(|r| f(r, r.yaw_rad.cos()) / r.variance[0]).sum::<f64>();
    sum(&|r, cos| cos * (r.shift[0] - slope * r.x[0][3])) / sum(&|_, cos| cos * cos).max(1e-9)
}

/// The same object comes to lie no farther from where it was in the next frame, m.
const NEXT_M: f64 = 2.5;

/// Fewer objects that are followed tell nothing of the errors of velocities.
const FEWEST_FOLLOWED: usize = 12;

/// Fewer objects of a frame tell nothing: two numbers of the frame, the own speed and the own turn, are not known.
const FEWEST_OF_FRAME: usize = 3;

/// An object against the others of its frame, what the own motion may do to all of them taken out.
struct Contrast<'a> {
    row: &'a Row,
    /// Seen velocity, m/s.
    seen: f64,
    /// Shift forward, m.
    shift: f64,
    /// What is left of a constant.
    constant: f64,
}

/// Slope of the shift forward over the seen velocity among the objects of a frame, s, and its standard error, beside a constant. A late clock shifts an
/// object by its velocity over the ground: the seen one, the own speed times the cosine of its heading, and the own turn times its lever. The last
/// two have one unknown factor a frame each, and are taken out. Velocities come from labels, which are not exact: the share of the slope that their
/// errors leave is known from objects that are followed, whose velocities stay the same from frame to frame and whose errors do not; where too few are,
/// the error is infinite.
pub(super) fn within_frames(rows: &[Row], which: &[usize], blocks: &[usize]) -> [f64; 2] {
    let mut contrasts: Vec<Contrast> = Vec::new();
    for frame in rows.chunk_by(|a, b| a.frame == b.frame).filter(|f| f.len() >= FEWEST_OF_FRAME) {
        let of = |f: &dyn Fn(&Row) -> f64| DVector::from_iterator(frame.len(), frame.iter().map(f));
        let speed = of(&|r| r.yaw_rad.cos()).normalize();
        let turn = of(&|r| r.center[0] * r.yaw_rad.sin() - r.center[1] * r.yaw_rad.cos());
        let turn = &turn - &speed * speed.dot(&turn);
        let turn = turn.try_normalize(1e-3).unwrap_or_else(|| DVector::zeros(frame.len()));
        let without = |v: DVector<f64>| &v - &speed * speed.dot(&v) - &turn * turn.dot(&v);
        let (seen, shift, constant) =
            (without(of(&|r| r.x[0][3])), without(of(&|r| r.shift[0])), without(of(&|_| 1.0)));
        contrasts.extend(frame.iter().enumerate().map(|(i, row)| Contrast {
            row,
            seen: seen[i],
            shift: shift[i],
            constant: constant[i],
        }));
    }
    let apart = |a: &Row, b: &Row| (0..3).map(|k| (a.center[k] - b.center[k]).powi(2)).sum::<f64>().sqrt();
    let followed = contrasts.iter().filter_map(|c| {
        let next = contrasts.iter().filter(|q| q.row.frame == c.row.frame + 1);
        let same = next.min_by(|p, q| apart(c.row, p.row).total_cmp(&apart(c.row, q.row)))?;
        (apart(c.row, same.row) < NEXT_M).then_some([c.seen, same.seen])
    });
    let followed: Vec<[f64; 2]> = followed.collect();
    let squares: f64 = followed.iter().map(|[a, b]| 0.5 * (a * a + b * b)).sum();
    let together: f64 = followed.iter().map(|[a, b]| a * b).sum();
    if followed.len() < FEWEST_FOLLOWED {
        return [0.0, f64::INFINITY];
    }
    let kept = (together / squares.max(1e-9)).clamp(0.05, 1.0);
    // Standard error of a correlation.
    let kept_error = (1.0 - kept * kept) / (followed.len() as f64).sqrt();
    let of_frame = |f: &usize| {
        let mut out = LinearFrame { gram: DMatrix::zeros(2, 2), right: DVector::zeros(2) };
        for c in contrasts.iter().filter(|c| c.row.frame == *f) {
            let x = DVector::from_row_slice(&[c.seen, c.constant]);
            out.gram += &x * x.transpose() / c.row.variance[0];
            out.right += x * (c.shift / c.row.variance[0]);
        }
        out
    };
    let frames: Vec<LinearFrame> = which.iter().map(of_frame).collect();
    let fitted = fit(&frames.iter().collect::<Vec<_>>(), blocks, &[0, 1], &[1.0, 1.0]);
    let slope = fitted.theta[0] / kept;
    [slope, (fitted.error(0) / kept).hypot(slope * kept_error / kept)]
}
