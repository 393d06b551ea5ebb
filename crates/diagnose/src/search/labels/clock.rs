//! Distinguishes a constant offset of labels from a late clock by the dependence on the relative velocity.

use super::rows::Row;
use crate::channels::motion::OwnMotion;
use crate::inference::linear::{LinearFrame, fit};
use crate::inference::median;
use nalgebra::{DMatrix, DVector};

/// Range of the ego speed, m/s: within 30 to 40 % of the estimate from the scenes, or that of any vehicle.
pub(super) fn own_speeds(motion: Option<&[Option<OwnMotion>]>) -> [f64; 2] {
    match median(motion.into_iter().flatten().flatten().map(|m| m.speed_m_s()).collect()) {
        v if v > 5.0 => [0.7 * v, 1.4 * v],
        _ => [4.0, 90.0],
    }
}

/// Whether a common offset may be a late clock: the dependence on the relative velocity that a late clock causes is
/// not excluded.
pub(super) fn late(forward_m: f64, [slope, error]: [f64; 2], speeds: [f64; 2]) -> bool {
    let ends = speeds.map(|v| forward_m / v);
    slope + 2.5 * error > ends[0].min(ends[1]) && slope - 2.5 * error < ends[0].max(ends[1])
}

/// Whether a common offset is a late clock: shifts depend significantly on the relative velocity, and a possible ego
/// speed explains the constant.
pub(super) fn surely_late(forward_m: f64, [slope, error]: [f64; 2], speeds: [f64; 2]) -> bool {
    slope.abs() > 3.2 * error && (speeds[0]..speeds[1]).contains(&(forward_m / slope))
}

/// Least standard deviation of the speeds of all road users of a long recording, as a share of their mean.
const SPEEDS_DIFFER: f64 = 0.2;

/// Shortest recording of which this holds, s.
const LONG_S: f64 = 10.0;

/// Whether all objects are shifted forward alike: a late clock would shift each by its speed, so that shifts along the
/// heading would scatter more than those across it.
pub(super) fn alike(rows: &[Row], which: &[usize], times: Option<&[f64]>) -> bool {
    let long = times.is_some_and(|t| t.last().zip(t.first()).is_some_and(|(last, first)| last - first > LONG_S));
    let rows: Vec<&Row> = rows.iter().filter(|r| which.contains(&r.frame)).collect();
    let n = rows.len() as f64;
    let mean = [0, 1].map(|axis: usize| rows.iter().map(|r| r.shift[axis]).sum::<f64>() / n);
    let square = |r: &Row, axis: usize| (r.shift[axis] - mean[axis]).powi(2);
    let of_frame = |frame: &[&Row]| frame.iter().map(|r| square(r, 0) - square(r, 1)).sum::<f64>();
    let more: Vec<f64> = rows.chunk_by(|a, b| a.frame == b.frame).map(of_frame).collect();
    let error = more.iter().map(|d| d * d).sum::<f64>().sqrt();
    long && (more.iter().sum::<f64>() + 2.5 * error) / n < (SPEEDS_DIFFER * mean[0]).powi(2)
}

/// Forward shift at zero relative velocity of an object with the heading of the ego vehicle, m. For oncoming objects
/// a late clock has the opposite sign.
pub(super) fn forward(rows: &[Row], slope: f64) -> f64 {
    let sum = |f: &dyn Fn(&Row, f64) -> f64| rows.iter().map(|r| f(r, r.yaw_rad.cos()) / r.variance[0]).sum::<f64>();
    sum(&|r, cos| cos * (r.shift[0] - slope * r.x[0][3])) / sum(&|_, cos| cos * cos).max(1e-9)
}

/// Largest relative movement of an object between consecutive frames, m.
const NEXT_M: f64 = 2.5;

/// Fewest objects that are tracked to the next frame.
const FEWEST_FOLLOWED: usize = 12;

/// Fewest objects of a frame: two parameters of the frame, ego speed and yaw rate, are not known.
const FEWEST_OF_FRAME: usize = 3;

/// An object relative to the others of its frame, the effect of ego motion subtracted.
struct Contrast<'a> {
    row: &'a Row,
    /// Relative velocity, m/s.
    seen: f64,
    /// Shift forward, m.
    shift: f64,
    /// Residual of a constant.
    constant: f64,
}

/// Slope of the forward shift over the relative velocity among the objects of a frame, s, and its standard error,
/// beside a constant.
///
/// A late clock shifts an object by its velocity over the ground: the relative one, the ego speed times the cosine of
/// its heading, and the yaw rate times its lever. The last two have one unknown factor for each frame and are
/// projected out. Velocities are from labels with errors, which attenuate the slope. The attenuation is estimated
/// from objects that are tracked: their velocities stay the same from frame to frame, the errors do not. Where too
/// few are tracked, the standard error is infinite.
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

#[cfg(test)]
mod tests {
    use super::super::rows::ALL;
    use super::*;
    use rand::RngExt;

    /// 20 frames of 12 objects with a shift forward by their speed.
    fn rows(shift: impl Fn(f64) -> f64) -> Vec<Row> {
        let mut rng = data::stream(0, "alike", 0, 0);
        let speeds: Vec<f64> = (0..12).map(f64::from).collect();
        let mut row = |frame: usize, object: usize| {
            let mut noise = || rng.random_range(-0.05..0.05);
            Row {
                frame,
                object,
                yaw_rad: 0.0,
                size_mm: [4000, 1800, 1500],
                center: [0.0; 3],
                shift: [shift(speeds[object]) + noise(), noise(), 0.0],
                variance: [1.0; 3],
                x: [[0.0; ALL]; 3],
                speed: None,
                known: [true; ALL],
            }
        };
        (0..20).flat_map(|frame| (0..12).map(move |object| (frame, object))).map(|(f, o)| row(f, o)).collect()
    }

    #[test]
    fn shifts_that_do_not_scatter_are_of_no_clock() {
        let which: Vec<usize> = (0..20).collect();
        let times: Vec<f64> = which.iter().map(|&f| f as f64).collect();
        let constant = rows(|_| 0.1);
        assert!(alike(&constant, &which, Some(&times)));
        let short: Vec<f64> = times.iter().map(|t| 0.1 * t).collect();
        assert!(!alike(&constant, &which, Some(&short)) && !alike(&constant, &which, None));
        assert!(!alike(&rows(|speed| 0.02 * speed), &which, Some(&times)));
    }
}
