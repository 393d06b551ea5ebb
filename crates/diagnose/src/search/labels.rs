//! Labels and objects: do measured labels stand where the measured returns are, and do the objects stand where the simulation has them?

mod finding;

use finding::*;

use super::{ChannelResult, Context, Found, Z_STAR, confidence, first_demands, parameter, record};
use crate::channels::labels::{ObjectShift, object_shifts};
use crate::channels::mean::origins;
use crate::channels::motion::{OwnMotion, own_motion};
use crate::diagnosis::{Curve, CurvePoint, Minimum, Status};
use crate::inference::choice::{Demands, Trial, choose, total_and_z};
use crate::inference::linear::{LinearFit, LinearFrame, cross_gains, fit};
use crate::inference::roles::Role;
use nalgebra::{DMatrix, DVector, Vector3};

/// What is compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Side {
    /// Measured labels with simulated labels.
    Labels,
    /// Measured returns on objects with simulated ones.
    Objects,
}

/// A linear cause of shifts in an object's own frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Cause {
    Forward,
    Left,
    Up,
    /// Velocity that the ego car sees, m/s: all positions late against the cloud.
    SeenVelocity,
    /// Velocity over the ground, m/s: the targets' positions late.
    Velocity,
    /// Longer: the visible one of front and rear stands out by half of it.
    Longer,
    /// Wider.
    Wider,
    /// Seen velocity times the phase of the scan.
    Swept,
}

const CAUSES: [Cause; 8] = [
    Cause::Forward,
    Cause::Left,
    Cause::Up,
    Cause::SeenVelocity,
    Cause::Velocity,
    Cause::Longer,
    Cause::Wider,
    Cause::Swept,
];

/// Names and their columns.
const CANDIDATES: [(&str, &[usize]); 13] = [
    ("label_offset", &[0]),
    ("label_offset", &[1]),
    ("label_offset", &[2]),
    ("label_offset", &[0, 1]),
    ("label_offset", &[0, 2]),
    ("label_offset", &[1, 2]),
    ("label_offset", &[0, 1, 2]),
    ("time_offset", &[3]),
    ("time_offset", &[4]),
    ("wrong_shape", &[5]),
    ("wrong_shape", &[6]),
    ("wrong_shape", &[5, 2]),
    ("rolling_shutter", &[7]),
];

/// Smaller constant shifts of labels and of objects are not spoken of, m.
const FLOOR_M: [f64; 2] = [0.03, 0.07];

/// Nor times below this, s.
const FLOOR_S: f64 = 0.001;

/// One object's shift with its covariates.
struct Row {
    frame: usize,
    shift: [f64; 3],
    variance: [f64; 3],
    x: [[f64; 8]; 3],
    speed: Option<f64>,
    known: [bool; 8],
}

/// The search on one side.
pub fn search(context: &Context, side: Side) -> ChannelResult {
    let motion = context.times.as_ref().map(|t| own_motion(context.frames, t, &origins(context.rig)));
    let shifts = object_shifts(context.frames, context.times.as_deref());
    let mut rows: Vec<Row> = shifts.iter().filter_map(|s| row(context, s, side, motion.as_deref())).collect();
    let mut result = ChannelResult::default();
    let [select, estimate, hold_out] = [Role::Select, Role::Estimate, Role::HoldOut].map(|r| context.of(r));
    let channel = if side == Side::Labels { "labels" } else { "objects" };
    if rows.iter().filter(|r| select.contains(&r.frame)).count() < 8 {
        result.distance = vec![[0.0; 3]; hold_out.len()];
        return result;
    }
    // A column that is not known for most objects is no candidate.
    let share = |k: usize| rows.iter().filter(|r| r.known[k]).count() as f64 / rows.len() as f64;
    let usable: Vec<bool> = (0..8).map(|k| share(k) > 0.6).collect();
    rows.retain(|r| (0..8).all(|k| r.known[k] || !usable[k]));
    rows.iter_mut().for_each(|r| r.x.iter_mut().for_each(|x| (0..8).filter(|&k| !usable[k]).for_each(|k| x[k] = 0.0)));
    set_noise(&mut rows, &select, side);
    let linear = |frames: &[usize]| -> Vec<LinearFrame> { frames.iter().map(|&f| sums(&rows, f)).collect() };
    let (on_select, blocks) = (linear(&select), context.blocks(&select));
    let frames: Vec<&LinearFrame> = on_select.iter().collect();
    let precision = [0.0; 8];
    let floor = FLOOR_M[usize::from(side == Side::Objects)];
    let trial = |k: usize, columns: &[usize], before: Option<&[f64]>| {
        let fitted = fit(&frames, &blocks, columns, &precision);
        let own = CANDIDATES[k].1;
        let size = (0..own.len()).map(|i| fitted.theta[columns.len() - own.len() + i].abs()).fold(0.0, f64::max);
        let mut gains = cross_gains(&frames, &blocks, columns, &precision);
        if let Some(before) = before {
            gains.iter_mut().zip(before).for_each(|(g, b)| *g -= b);
        }
        let least = if CANDIDATES[k].0 == "time_offset" {
            FLOOR_S
        } else if CANDIDATES[k].0 == "rolling_shutter" {
            0.005
        } else {
            floor
        };
        Trial { candidate: k, name: CANDIDATES[k].0.into(), parameters: own.len(), gains, above_floor: size > least }
    };
    let allowed = |k: &usize| {
        let (name, columns) = CANDIDATES[*k];
        columns.iter().all(|&c| usable[c])
            && (side == Side::Objects || !matches!(name, "wrong_shape" | "rolling_shutter"))
    };
    let demands = Demands { nats: 6.0, slack: 0.03, ..first_demands() };
    let trials: Vec<Trial> = (0..CANDIDATES.len()).filter(allowed).map(|k| trial(k, CANDIDATES[k].1, None)).collect();
    let choice = choose(&trials, &demands);
    let returns = context.returns(&select);
    result.considered = record(&trials, choice.as_ref(), channel, returns, &demands);
    if side == Side::Labels {
        let error = |k: usize| fit(&frames, &blocks, &[k], &precision).error(0);
        let least = |name: &str, parameter: &str, value: f64, unit: &str| {
            (name.to_owned(), Minimum { parameter: parameter.into(), value, unit: unit.into() })
        };
        result.minimum.push(least("label_offset", "forward_m", (Z_STAR * error(0)).max(floor), "m"));
        if let Some(k) = [4, 3].into_iter().find(|&k| usable[k]) {
            result.minimum.push(least("time_offset", "dt_s", (Z_STAR * error(k)).max(FLOOR_S), "s"));
        }
    }
    let Some(first) = choice else {
        result.distance = hold_out.iter().map(|&f| distance(&rows, f, None)).collect();
        return result;
    };
    let mut chosen = vec![trials[first.chosen].candidate];
    let mut stories =
        vec![(equals(&trials, &first.equals), confidence(&trials, &blocks, &trials[first.chosen].name, &demands))];
    let (first_gain, _) = total_and_z(&trials[first.chosen].gains);
    let second_demands = Demands { nats: (0.1 * first_gain).max(8.0), ..demands };
    let first_columns = CANDIDATES[chosen[0]].1;
    let rivals: Vec<Trial> = (0..CANDIDATES.len())
        .filter(allowed)
        .filter(|&k| {
            CANDIDATES[k].0 != CANDIDATES[chosen[0]].0 && CANDIDATES[k].1.iter().all(|c| !first_columns.contains(c))
        })
        .map(|k| trial(k, &[first_columns, CANDIDATES[k].1].concat(), Some(&trials[first.chosen].gains)))
        .collect();
    if let Some(second) = choose(&rivals, &second_demands) {
        chosen.push(rivals[second.chosen].candidate);
        let name = rivals[second.chosen].name.clone();
        stories.push((equals(&rivals, &second.equals), confidence(&rivals, &blocks, &name, &second_demands)));
    }
    let columns: Vec<usize> = chosen.iter().flat_map(|&k| CANDIDATES[k].1.to_vec()).collect();
    let on_estimate = linear(&estimate);
    let fitted = fit(&on_estimate.iter().collect::<Vec<_>>(), &context.blocks(&estimate), &columns, &precision);
    let on_hold_out = linear(&hold_out);
    let mut at = 0;
    for (k, (equals, confidence)) in chosen.iter().zip(stories) {
        let own = at..at + CANDIDATES[*k].1.len();
        at = own.end;
        let mut without = fitted.clone();
        own.clone().for_each(|i| without.theta[i] = 0.0);
        let gains = on_hold_out.iter().map(|f| fitted.gain(f) - without.gain(f)).collect();
        result.found.push(found(*k, &fitted, own, equals, confidence, gains, side, &rows, &usable));
    }
    result.distance = hold_out.iter().map(|&f| distance(&rows, f, Some(&fitted))).collect();
    result
}

fn equals(trials: &[Trial], which: &[usize]) -> Vec<String> {
    let mut names: Vec<String> = which.iter().map(|&i| trials[i].name.clone()).collect();
    names.sort();
    names.dedup();
    names
}

fn row(context: &Context, s: &ObjectShift, side: Side, motion: Option<&[Option<OwnMotion>]>) -> Option<Row> {
    let (shift, variance) = match side {
        Side::Labels => (s.label_m, [1.0; 3]),
        Side::Objects => {
            let (shift, error) = s.cloud_m?;
            (shift, error.map(|e| e * e))
        }
    };
    if shift.iter().any(|v| v.abs() > 3.0) {
        return None;
    }
    let object = context.frames[s.frame].objects.iter().filter_map(|o| o.simulated).min_by(|a, b| {
        let d = |b: &geometry::Box3| {
            (b.center[1].atan2(b.center[0]) - s.azimuth_rad).abs()
                + (b.center[0].hypot(b.center[1]) - s.distance_m).abs()
        };
        d(a).total_cmp(&d(b))
    })?;
    let (sin, cos) = object.yaw_rad.sin_cos();
    let axes = |v: Vector3<f64>| [v.x * cos + v.y * sin, -v.x * sin + v.y * cos, v.z];
    let center = Vector3::from(object.center);
    let mut x = [[0.0; 8]; 3];
    let mut known = [true; 8];
    for (k, x) in x.iter_mut().enumerate() {
        x[k] = 1.0;
    }
    let mut speed = None;
    match s.seen_velocity_m_s {
        Some(seen) => {
            (0..3).for_each(|k| x[k][3] = seen[k]);
            let phase =
                context.rig.sensors.iter().map(|m| (crate::rig::wrapped(s.azimuth_rad - m.yaw_deg.to_radians()), m));
            let phase = phase
                .min_by(|a, b| a.0.abs().total_cmp(&b.0.abs()))
                .map_or(0.0, |(az, m)| az / (2.0 * m.half_fov_rad()));
            (0..3).for_each(|k| x[k][7] = seen[k] * phase);
            match motion.and_then(|m| m[s.frame]) {
                Some(own) => {
                    let carried = Vector3::new(own.speed_m_s, 0.0, 0.0)
                        + Vector3::new(0.0, 0.0, own.yaw_rate_rad_s).cross(&center);
                    let carried = axes(carried);
                    (0..3).for_each(|k| x[k][4] = seen[k] + carried[k]);
                    speed = Some(x[0][4]);
                }
                None => known[4] = false,
            }
        }
        None => (known[3], known[4], known[7]) = (false, false, false),
    }
    let towards = axes(-center / center.norm().max(1e-6));
    x[0][5] = towards[0];
    x[1][6] = towards[1];
    Some(Row { frame: s.frame, shift, variance, x, speed, known })
}

/// Variances from what a fit of all columns leaves: robust, an axis at a time.
fn set_noise(rows: &mut [Row], select: &[usize], side: Side) {
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
        let mut left: Vec<f64> = rows
            .iter()
            .filter(|r| select.contains(&r.frame))
            .filter(|r| side == Side::Labels || r.variance[axis] < 0.1)
            .map(|r| (r.shift[axis] - (0..8).map(|k| r.x[axis][k] * theta[k]).sum::<f64>()).abs())
            .collect();
        left.sort_by(f64::total_cmp);
        let scale = (left.get(left.len() / 2).copied().unwrap_or(0.1) / 0.6745).max(0.008);
        for r in rows.iter_mut() {
            r.variance[axis] = if side == Side::Labels { scale * scale } else { r.variance[axis] + scale * scale };
        }
    }
}
