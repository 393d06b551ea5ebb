//! A constant offset of labels, or a late clock? The dependence on the velocity that the own car sees.

use super::Row;
use crate::channels::motion::OwnMotion;
use crate::inference::linear::{LinearFrame, fit};
use nalgebra::{DMatrix, DVector};

/// What the own speed may be, m/s: from the scene, or anything that a car does.
pub(super) fn own_speeds(motion: Option<&[Option<OwnMotion>]>) -> [f64; 2] {
    let mut known: Vec<f64> = motion.into_iter().flatten().flatten().map(|m| m.speed_m_s).collect();
    known.sort_by(f64::total_cmp);
    match known.get(known.len() / 2) {
        Some(&v) if v > 5.0 => [0.7 * v, 1.4 * v],
        _ => [4.0, 90.0],
    }
}

/// Whether an offset that is the same for all could as well be a late clock: the dependence on the seen velocity that this would make is
/// not excluded.
pub(super) fn late(forward_m: f64, [slope, error]: [f64; 2], speeds: [f64; 2]) -> bool {
    let ends = speeds.map(|v| forward_m / v);
    slope + 2.5 * error > ends[0].min(ends[1]) && slope - 2.5 * error < ends[0].max(ends[1])
}

/// Mean shift forward at no seen velocity, m.
pub(super) fn forward(rows: &[Row], slope: f64) -> f64 {
    let sum = |f: &dyn Fn(&Row) -> f64| rows.iter().map(|r| f(r) / r.variance[0]).sum::<f64>();
    sum(&|r| r.shift[0] - slope * r.x[0][3]) / sum(&|_| 1.0).max(1e-9)
}

/// Objects turned by less against the own car drive as it does, rad: in a turn the velocity along their own axes is another one.
const ALONG_RAD: f64 = 0.12;

/// The same object comes to lie no farther from where it was in the next frame, m.
const NEXT_M: f64 = 2.5;

/// Fewer objects that are followed tell nothing of the errors of velocities.
const FEWEST_FOLLOWED: usize = 12;

/// Slope of the shift forward over the seen velocity among the objects of a frame, s, and its standard error: what the own car's speed does is
/// the same for all of them. Velocities come from labels, which are not exact: the share of the slope that their errors leave, at least a twentieth, is
/// known from objects that are followed, whose velocities stay the same from frame to frame and whose errors do not.
pub(super) fn within_frames(rows: &[Row], select: &[usize], blocks: &[usize]) -> [f64; 2] {
    // Seen velocity and shift about their means over the frame.
    let mut contrasts: Vec<(&Row, f64, f64)> = Vec::new();
    for frame in rows.chunk_by(|a, b| a.frame == b.frame) {
        let along: Vec<&Row> = frame.iter().filter(|r| r.yaw_rad.abs() < ALONG_RAD).collect();
        let mean = |f: &dyn Fn(&Row) -> f64| along.iter().map(|r| f(r)).sum::<f64>() / along.len().max(1) as f64;
        let (v, y) = (mean(&|r| r.x[0][3]), mean(&|r| r.shift[0]));
        contrasts.extend(along.iter().map(|r| (*r, r.x[0][3] - v, r.shift[0] - y)));
    }
    let apart = |a: &Row, b: &Row| (0..3).map(|k| (a.center[k] - b.center[k]).powi(2)).sum::<f64>().sqrt();
    let followed = contrasts.iter().filter_map(|(r, v, _)| {
        let next = contrasts.iter().filter(|(q, ..)| q.frame == r.frame + 1);
        let (same, w, _) = next.min_by(|(p, ..), (q, ..)| apart(r, p).total_cmp(&apart(r, q)))?;
        (apart(r, same) < NEXT_M).then_some([*v, *w])
    });
    let followed: Vec<[f64; 2]> = followed.collect();
    let squares: f64 = followed.iter().map(|[a, b]| 0.5 * (a * a + b * b)).sum();
    let together: f64 = followed.iter().map(|[a, b]| a * b).sum();
    let kept = if followed.len() < FEWEST_FOLLOWED { 0.05 } else { (together / squares.max(1e-9)).clamp(0.05, 1.0) };
    let of_frame = |f: &usize| {
        let mut out = LinearFrame { gram: DMatrix::zeros(1, 1), right: DVector::zeros(1) };
        for (r, v, y) in contrasts.iter().filter(|(r, ..)| r.frame == *f) {
            out.gram[(0, 0)] += v * v / r.variance[0];
            out.right[0] += v * y / r.variance[0];
        }
        out
    };
    let frames: Vec<LinearFrame> = select.iter().map(of_frame).collect();
    let fitted = fit(&frames.iter().collect::<Vec<_>>(), blocks, &[0], &[1.0]);
    [fitted.theta[0] / kept, fitted.error(0) / kept]
}
