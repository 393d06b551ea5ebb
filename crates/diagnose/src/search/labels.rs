//! Labels and objects: do measured labels stand where the measured returns are, and do the objects stand where the simulation has them?

mod clock;
mod words;

use self::clock::{forward, late, own_speeds, surely_late, within_frames};
use super::geometry::Displacement;
use super::{ChannelResult, Context, Repair, Z_STAR, confidence, first_demands, record};
use crate::channels::labels::{ObjectShift, object_shifts};
use crate::channels::mean::origins;
use crate::channels::motion::OwnMotion;
use crate::diagnosis::Minimum;
use crate::inference::choice::{Demands, Trial, as_good, choose, total_and_z};
use crate::inference::linear::{LinearFit, LinearFrame, cross_gains, fit};
use crate::inference::roles::Role;
use nalgebra::{DMatrix, DVector, Vector3};
use sensor::Sensor;

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
const CANDIDATES: [(&str, &[usize]); 14] = [
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
    // The targets' clock where the own speed is not known: the constant is the own speed's share of it.
    ("time_offset", TARGETS_CLOCK),
];

/// Columns of the targets' clock where the own speed is not known.
const TARGETS_CLOCK: &[usize] = &[0, 3];

/// Smaller constant shifts of labels and of objects are not spoken of, m.
const FLOOR_M: [f64; 2] = [0.03, 0.07];

/// Nor times below this, s.
const FLOOR_S: f64 = 0.001;

/// What surfaces are fitted wrongly by does not tell causes of shifts of objects apart whose gains differ by a smaller share, however sure that is.
const AS_GOOD: f64 = 0.02;

/// One object's shift with its covariates.
struct Row {
    frame: usize,
    object: usize,
    yaw_rad: f64,
    center: [f64; 3],
    shift: [f64; 3],
    variance: [f64; 3],
    x: [[f64; 8]; 3],
    speed: Option<f64>,
    known: [bool; 8],
}

/// Objects that move by less are not spoken of, m: labels, objects.
const LEAST_MOVED_M: [f64; 2] = [0.02, 0.04];

/// The search on one side; `displaced` tells how far things are shown from where they are for reasons of the geometry.
pub fn search(context: &Context, side: Side, displaced: &Displacement) -> ChannelResult {
    let motion = &context.motion;
    let shifts = object_shifts(context.frames, context.times.as_deref());
    let mut rows: Vec<Row> =
        shifts.iter().filter_map(|s| row(context, s, side, motion.as_deref(), displaced)).collect();
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
    let speeds = own_speeds(motion.as_deref());
    let line = within_frames(&rows, &select, &blocks);
    let clock = usable[3] && surely_late(forward(&rows, line[0]), line, speeds);
    let trial = |k: usize, columns: &[usize], before: Option<&[f64]>| {
        let fitted = fit(&frames, &blocks, columns, &precision);
        let own = CANDIDATES[k].1;
        let theta: Vec<f64> = (0..own.len()).map(|i| fitted.theta[columns.len() - own.len() + i]).collect();
        let size = theta.iter().map(|t| t.abs()).fold(0.0, f64::max);
        let moved = moved_m(&rows, own, &theta);
        let plausible = match CANDIDATES[k] {
            (_, TARGETS_CLOCK) => clock,
            ("label_offset", own) => !(clock && own.contains(&0)),
            _ => true,
        };
        let mut gains = cross_gains(&frames, &blocks, columns, &precision);
        if let Some(before) = before {
            gains.iter_mut().zip(before).for_each(|(g, b)| *g -= b);
        }
        let least = if own == TARGETS_CLOCK {
            floor
        } else if CANDIDATES[k].0 == "time_offset" {
            FLOOR_S
        } else if CANDIDATES[k].0 == "rolling_shutter" {
            0.005
        } else {
            floor
        };
        Trial {
            candidate: k,
            name: CANDIDATES[k].0.into(),
            parameters: own.len(),
            gains,
            above_floor: plausible && size > least && moved > LEAST_MOVED_M[usize::from(side == Side::Objects)],
        }
    };
    let allowed = |k: &usize| {
        let (name, columns) = CANDIDATES[*k];
        columns.iter().all(|&c| usable[c])
            && (side == Side::Objects || !matches!(name, "wrong_shape" | "rolling_shutter"))
    };
    let demands = Demands { nats: 6.0, slack: 0.03, told: 0.03, ..first_demands() };
    let trials: Vec<Trial> = (0..CANDIDATES.len()).filter(allowed).map(|k| trial(k, CANDIDATES[k].1, None)).collect();
    let choice = choose(&trials, &demands);
    let returns = context.returns(&select);
    result.considered = record(&trials, choice.as_ref(), channel, returns, &demands);
    for (considered, t) in result.considered.iter_mut().zip(&trials).filter(|_| clock) {
        if t.name == "label_offset" && CANDIDATES[t.candidate].1.contains(&0) {
            considered.outcome = "objects of the same frame are shifted by their speeds, not all alike".into();
        }
    }
    if side == Side::Labels {
        let error = |k: usize| fit(&frames, &blocks, &[k], &precision).error(0);
        let least = |name: &str, parameter: &str, value: f64, unit: &str| {
            (name.to_owned(), Minimum { parameter: parameter.into(), value, unit: unit.into() })
        };
        result.minimum.push(least("label_offset", "forward_m", (Z_STAR * error(0)).max(floor), "m"));
        if let Some(k) = [4, 3].into_iter().find(|&k| usable[k]) {
            result.minimum.push(least("time_offset", "offset_s", (Z_STAR * error(k)).max(FLOOR_S), "s"));
        }
    }
    let Some(first) = choice else {
        result.distance = hold_out.iter().map(|&f| [distance(&rows, f), 0.0, 0.0]).collect();
        return result;
    };
    let mut chosen = vec![trials[first.chosen].candidate];
    let mut stories =
        vec![(equals(&trials, &first.equals), confidence(&trials, &blocks, &trials[first.chosen].name, &demands))];
    if side == Side::Objects {
        stories[0].0.extend(as_good(&trials, first.chosen, AS_GOOD));
    }
    let (name, own) = CANDIDATES[chosen[0]];
    // Where no speeds are known nothing speaks against a late clock.
    let forward_alike = name == "label_offset" && own.contains(&0);
    if forward_alike && (!usable[3] || late(forward(&rows, line[0]), line, speeds)) {
        stories[0].0.push("time_offset".into());
    }
    stories[0].0.sort();
    stories[0].0.dedup();
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
    let late_by = within_frames(&rows, &estimate, &context.blocks(&estimate));
    let late_by = if late_by[1].is_finite() { late_by } else { line };
    let mut at = 0;
    for (k, (equals, confidence)) in chosen.iter().zip(stories) {
        let own = at..at + CANDIDATES[*k].1.len();
        at = own.end;
        let mut without = fitted.clone();
        own.clone().for_each(|i| without.theta[i] = 0.0);
        let gains = on_hold_out.iter().map(|f| fitted.gain(f) - without.gain(f)).collect();
        result.found.push(words::found(*k, &fitted, own, equals, confidence, gains, side, &rows, &usable, late_by));
    }
    let known: Vec<usize> = (0..8).filter(|&k| usable[k]).collect();
    let best = fit(&on_estimate.iter().collect::<Vec<_>>(), &context.blocks(&estimate), &known, &[1e-3; 8]);
    let of_frame = |(&f, sums): (&usize, &LinearFrame)| [distance(&rows, f), fitted.gain(sums), best.gain(sums)];
    result.distance = hold_out.iter().zip(&on_hold_out).map(of_frame).collect();
    let of_labels = |k: &usize| matches!(CANDIDATES[*k].0, "label_offset" | "time_offset");
    if chosen.iter().all(of_labels) {
        result.repairs = rows.iter().map(|r| repair(r, &fitted, side)).collect();
    }
    result
}

/// How a measured label is to be moved so that it stands on its returns.
fn repair(r: &Row, fitted: &LinearFit, side: Side) -> Repair {
    let told = [0, 1, 2]
        .map(|axis: usize| fitted.columns.iter().zip(fitted.theta.iter()).map(|(&c, t)| r.x[axis][c] * t).sum::<f64>());
    // Labels that are off go back; objects that stand elsewhere take their labels along.
    let sign = if side == Side::Labels { -1.0 } else { 1.0 };
    let (s, c) = r.yaw_rad.sin_cos();
    let shift = Vector3::new(told[0] * c - told[1] * s, told[0] * s + told[1] * c, told[2]) * sign;
    Repair { frame: r.frame, object: r.object, shift_m: shift.into() }
}

fn equals(trials: &[Trial], which: &[usize]) -> Vec<String> {
    let mut names: Vec<String> = which.iter().map(|&i| trials[i].name.clone()).collect();
    names.sort();
    names.dedup();
    names
}

fn row(
    context: &Context,
    s: &ObjectShift,
    side: Side,
    motion: Option<&[Option<OwnMotion>]>,
    displaced: &Displacement,
) -> Option<Row> {
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
    let nearest = (0..context.rig.sensors.len()).min_by(|&a, &b| {
        let off = |k: usize| {
            let mount = &context.rig.sensors[k];
            crate::angle::wrapped(s.azimuth_rad - mount.yaw_deg.to_radians()).abs() / mount.half_fov_rad()
        };
        off(a).total_cmp(&off(b))
    });
    let sensor = nearest.unwrap_or(0);
    if side == Side::Objects {
        let origin = origins(context.rig)[sensor];
        let known = axes(displaced.of_point(&center, sensor, &origin));
        (0..3).for_each(|k| shift[k] -= known[k]);
    }
    if shift.iter().any(|v| v.abs() > 3.0) {
        return None;
    }
    let mut x = [[0.0; 8]; 3];
    let mut known = [true; 8];
    for (k, x) in x.iter_mut().enumerate() {
        x[k] = 1.0;
    }
    let mut speed = None;
    match s.seen_velocity_m_s {
        Some(seen) => {
            (0..3).for_each(|k| x[k][3] = seen[k]);
            let mount = &context.rig.sensors[sensor];
            let [azimuth_rad, elevation_rad, _] =
                Sensor::spherical(&mount.pose().inverse_transform_point(&center.into()));
            let phase = mount.scan_phase(azimuth_rad, elevation_rad);
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

fn sums(rows: &[Row], frame: usize) -> LinearFrame {
    let mut out = LinearFrame { gram: DMatrix::zeros(8, 8), right: DVector::zeros(8) };
    for r in rows.iter().filter(|r| r.frame == frame) {
        for axis in 0..3 {
            let x = DVector::from_row_slice(&r.x[axis]);
            let w = robust(r, axis) / r.variance[axis];
            out.gram += &x * x.transpose() * w;
            out.right += &x * (w * r.shift[axis]);
        }
    }
    out
}

/// A wild shift counts less.
fn robust(r: &Row, axis: usize) -> f64 {
    let u = r.shift[axis].abs() / (2.0 + 6.0 * r.variance[axis].sqrt());
    if u < 1.0 { 1.0 } else { 1.0 / u }
}

/// Root mean square of what columns with coefficients move objects by, m.
fn moved_m(rows: &[Row], columns: &[usize], theta: &[f64]) -> f64 {
    let told = |r: &Row, axis: usize| columns.iter().zip(theta).map(|(&c, t)| r.x[axis][c] * t).sum::<f64>();
    let squares: f64 = rows.iter().map(|r| (0..3).map(|axis| told(r, axis).powi(2)).sum::<f64>()).sum();
    (squares / rows.len().max(1) as f64).sqrt()
}

/// Half the squared shifts in units of their noise.
fn distance(rows: &[Row], frame: usize) -> f64 {
    let of = |r: &Row| (0..3).map(|axis| 0.5 * robust(r, axis) / r.variance[axis] * r.shift[axis].powi(2)).sum::<f64>();
    rows.iter().filter(|r| r.frame == frame).map(of).sum()
}
