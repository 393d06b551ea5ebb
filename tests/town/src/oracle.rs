//! What an oracle that knows all forms would see of the hidden effects of a case.
//!
//! Every frame is compared with the same frame without one effect (or a part of one), shot by shot, in what is
//! expected. Some shots of each frame stand for all.

use crate::case::Case;
use crate::effect::Effect;
use crate::frame::{Echo, Frame, Met};
use crate::parts::{Part, SMALLER, Scaling};
use crate::sensor::Shot;
use crate::side::{MEMORY_S, POSE_STD, Side, TRACK_SHARE, UNSTEADY_STD};
use crate::world::{Object, REACH_M};
use nalgebra::Vector3;
use rayon::prelude::*;
use score::{Counts, FrameEvidence, FrameStds, Oracle, Row, bernoulli_divergence};
use std::collections::BTreeMap;

/// What an oracle knows of a hidden effect.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Judgement {
    /// Standard errors.
    pub strength: f64,
    /// Expected number of returns, over all frames, that are removed, added, or moved by more than 0.35 m.
    pub touched: f64,
    /// Standard errors of parameters.
    pub bound: BTreeMap<String, f64>,
}

/// Shots of a frame that are compared, at most.
const SHOTS: usize = 1_500;

/// Frames that are compared, at most.
const FRAMES: usize = 60;

/// Displacement from which on a return counts as elsewhere, m.
const ELSEWHERE_M: f64 = 0.35;

/// Smallest cosine of incidence of a residual.
const LEAST_COS: f64 = 0.05;

/// Standard deviations of the offsets of houses, of ground and of other surfaces along their normals, m.
const SURFACE_STD_M: [f64; 3] = [0.0115, 0.002, 0.01];

/// Relative scatter of the intensity of returns: speckle and errors of reflectivities.
const INTENSITY_STD: f64 = 0.06;

/// Resolution of a range in which no rounding is seen, m.
const RESOLUTION_M: f64 = 1.5e-3;

/// Probability that a shot meets something else than in the model, away from edges.
const SURPRISE: f64 = 0.003;

/// A part of an effect, the side without it, and the side with the part a little smaller if it turns or shifts rays.
struct Variant {
    effect: usize,
    part: Part,
    side: Side,
    nearly: Option<Side>,
}

/// Judges the hidden effects of a case, in their order.
pub fn judge(case: &Case) -> Vec<Judgement> {
    let side = &case.measured;
    if case.hidden().is_empty() {
        return vec![];
    }
    let variants = variants(case);
    let plain = side.with_effects(&case.real_world, vec![]);
    let every = case.size.frames.div_ceil(FRAMES);
    let chosen: Vec<usize> = (0..case.size.frames).step_by(every).collect();
    let frames: Vec<FrameEvidence> =
        chosen.par_iter().map(|&i| compare(case, &variants, &plain, i, every as f64)).collect();
    // Nuisances that last longer than the time between frames are averaged less well.
    let keep = (-side.setting.step_s() * every as f64 / MEMORY_S).exp();
    let independent = (1.0 - keep) / (1.0 + keep);
    let slow = |std: f64| std / independent.sqrt();
    let [noise, lost, threshold, range, false_returns] = UNSTEADY_STD.map(slow);
    let [shift, turn] = POSE_STD.map(slow);
    let stds = FrameStds {
        means: vec![shift, shift, shift, turn, turn, turn, range],
        variances: vec![noise],
        losses: vec![lost, threshold],
        false_returns,
        independent,
    };
    let mut oracle = Oracle::new(side.effects.len(), variants.iter().map(|v| v.effect).collect(), stds);
    frames.iter().for_each(|frame| oracle.add(frame));
    let verdicts = oracle.judge();
    let judgement = |k: usize| {
        let mut bound = BTreeMap::new();
        for (column, Variant { part, .. }) in variants.iter().enumerate().filter(|(_, v)| v.effect == k) {
            let relative = match part.scaling {
                Scaling::Shift => verdicts.shift_error(column),
                Scaling::Deviation => verdicts.deviation_error(column),
                Scaling::LostShare => Some(verdicts.lost_error(column, part.value)),
                Scaling::ClutterShare => Some(verdicts.clutter_error(part.value)),
                Scaling::Other => None,
            };
            bound.extend(relative.map(|relative| (part.name.to_owned(), part.value.abs() * relative)));
        }
        Judgement { strength: verdicts.strength(k), touched: verdicts.touched(k), bound }
    };
    (0..side.effects.len()).map(judgement).collect()
}

/// The measured side without each part of each effect.
fn variants(case: &Case) -> Vec<Variant> {
    let side = &case.measured;
    let replaced = |k: usize, by: Option<Effect>| {
        let mut effects = side.effects.clone();
        match by {
            Some(effect) => effects[k] = effect,
            None => drop(effects.remove(k)),
        }
        side.with_effects(&case.real_world, effects)
    };
    let parts = side.effects.iter().enumerate().flat_map(|(k, e)| e.parts().into_iter().map(move |part| (k, part)));
    let variant = |(effect, part): (usize, Part)| Variant {
        effect,
        side: replaced(effect, part.remaining.clone()),
        nearly: part.nearly.clone().map(|nearly| replaced(effect, Some(nearly))),
        part,
    };
    parts.map(variant).collect()
}

/// What is expected of a shot.
struct Expected {
    echo: Option<Echo>,
    mean_m: f64,
    variance_m2: f64,
    kept: f64,
    /// Rate of returns from elsewhere, and the mean extent of their ranges, m.
    clutter: [f64; 2],
}

fn expected(frame: &Frame, shot: &Shot, met: &Met) -> Expected {
    let mut jitter_m2 = 0.0;
    if let Some(echo) = &met.first {
        let tan2 = (1.0 / echo.cos_incidence.max(LEAST_COS).powi(2) - 1.0).max(0.0);
        for effect in &frame.side.effects {
            if let Effect::AngularJitter { std_rad } = effect {
                jitter_m2 += (std_rad * echo.range_m).powi(2) * tan2;
            }
        }
    }
    let ways = frame.clutter(shot, met.first.as_ref());
    let second = met.second_m.map_or(0.0, |_| frame.second_share());
    let rate = ways.iter().map(|w| w.rate).sum::<f64>() + second;
    let extent = ways.iter().map(|w| w.rate * w.law.extent_m()).sum::<f64>() + 0.2 * second;
    Expected {
        mean_m: met.first.as_ref().map_or(0.0, |e| e.range_m + frame.shift_m(shot, e)),
        variance_m2: met.first.as_ref().map_or(0.0, |e| frame.scatter(shot, e).variance_m2()) + jitter_m2,
        kept: met.first.as_ref().map_or(0.0, |e| frame.kept(shot, e)),
        clutter: [rate, if rate > 0.0 { extent / rate } else { REACH_M }],
        echo: met.first,
    }
}

/// Displacement between two expectations along the ray, m; `None` if something else is met. If the ray itself differs,
/// that is the displacement on the plane of the surface, as it is for a small change of a pose.
fn displacement_m(a: &Expected, b: &Expected) -> Option<f64> {
    let (Some(x), Some(y)) = (&a.echo, &b.echo) else { return None };
    if x.object != y.object {
        return None;
    }
    let (turned, shifted) = (x.ray - y.ray, x.origin - y.origin);
    if turned.norm_squared() + shifted.norm_squared() < 1e-16 {
        return Some(a.mean_m - b.mean_m).filter(|d| d.abs() < ELSEWHERE_M);
    }
    let along = x.normal.dot(&x.ray);
    Some(-x.normal.dot(&(shifted + turned * x.range_m)) / along)
}

/// Displacement by a part, as if it were small, from the frame in which it is a little smaller, m.
fn derivative_m(nearly: &Frame, shot: &Shot, all: &Expected) -> Option<f64> {
    let one = expected(nearly, shot, &nearly.trace(shot, [0.0; 2]));
    displacement_m(all, &one).map(|displacement| displacement / SMALLER)
}

/// Compares a frame with the frames without each part. A frame counts `weight` times.
fn compare(case: &Case, variants: &[Variant], plain: &Side, index: usize, weight: f64) -> FrameEvidence {
    let side = &case.measured;
    let frame = Frame::new(side, index);
    let others: Vec<Frame> = variants.iter().map(|v| Frame::new(&v.side, index)).collect();
    let nearly: Vec<Option<Frame>> =
        variants.iter().map(|v| v.nearly.as_ref().map(|side| Frame::new(side, index))).collect();
    let [real, model] = [plain, &case.simulated].map(|side| Frame::new(side, index));
    let counts = vec![Counts::default(); side.effects.len()];
    let mut sums = FrameEvidence { counts, ..FrameEvidence::default() };
    let mut on_vehicle: BTreeMap<u32, f64> = BTreeMap::new();
    for sensor in 0..side.mounts.len() {
        let shots = side.shots(sensor, index);
        // An odd step visits all rows.
        let stride = (shots.len() * side.mounts.len()).div_ceil(SHOTS) | 1;
        let each = weight * stride as f64;
        for shot in shots.iter().step_by(stride) {
            let met = frame.trace(shot, [0.0; 2]);
            let all = expected(&frame, shot, &met);
            let [a, b] = [&real, &model].map(|f| expected(f, shot, &f.trace(shot, [0.0; 2])));
            let is_edge = displacement_m(&a, &b).is_none_or(|d| d.abs() > ELSEWHERE_M) && a.echo.is_some();
            sums.shots += each;
            sums.returns += each * all.kept;
            if let Some(Object::Vehicle(number)) = all.echo.map(|e| e.object) {
                *on_vehicle.entry(number).or_default() += all.kept * stride as f64;
            }
            let columns = variants.len();
            let [mut mean, mut variance, mut loss] = [(); 3].map(|()| vec![0.0; columns]);
            for (v, variant) in variants.iter().enumerate() {
                let effect = &side.effects[variant.effect];
                let met = if effect.changes_rays() { others[v].trace(shot, [0.0; 2]) } else { met };
                let one = expected(&others[v], shot, &met);
                // Parts share the counts of their effect.
                let mut nothing = Counts::default();
                let first = v == 0 || variants[v - 1].effect != variant.effect;
                let c = if first { &mut sums.counts[variant.effect] } else { &mut nothing };
                match displacement_m(&all, &one) {
                    Some(displacement) => {
                        mean[v] = displacement;
                        variance[v] = all.variance_m2 - one.variance_m2;
                        loss[v] = all.kept - one.kept;
                        c.divergence += each * bernoulli_divergence(all.kept, one.kept);
                        let moved = if displacement.abs() > ELSEWHERE_M { all.kept } else { 0.0 };
                        c.touched += each * (one.kept - all.kept).max(moved);
                    }
                    None if all.echo.is_some() || one.echo.is_some() => {
                        c.moved += each;
                        c.moved_usual += each * if is_edge { 1.0 } else { SURPRISE };
                        c.touched += each * all.kept.max(one.kept);
                    }
                    None => {}
                }
                if let Some(nearly) = &nearly[v] {
                    mean[v] = derivative_m(nearly, shot, &all).unwrap_or(0.0);
                }
                let more = (all.clutter[0] - one.clutter[0]).max(0.0);
                let usual = frame.usual_clutter().rate + one.clutter[0];
                c.clutter += each * more;
                c.touched += each * more;
                if more > 0.0 {
                    c.clutter_usual += each * usual * (all.clutter[1] / REACH_M).min(1.0);
                }
                c.other += each * all.kept * other_information(effect, side, shot);
            }
            if let Some(echo) = all.echo.filter(|e| e.normal.dot(&e.ray).abs() > LEAST_COS) {
                let (noise_m2, counted) = (side.nuisances.noise_m.powi(2), each * all.kept);
                let total = all.variance_m2 + noise_m2;
                sums.means.push(mean_row(&frame, shot, &echo, mean, counted / total));
                let weight = 0.5 * counted / (total * total);
                sums.variances.push(Row { columns: variance, frame: vec![2.0 * noise_m2], patch: None, weight });
                let signal = echo.signal() - frame.attenuation(echo.range_m);
                let usual = frame.usually_kept(signal);
                let by_threshold = all.kept * (frame.usually_kept(signal - 0.05) / usual.max(1e-9) - 1.0) / 0.05;
                let p = all.kept.clamp(2e-3, 1.0 - 2e-3);
                sums.losses.push(Row {
                    columns: loss,
                    frame: vec![-side.nuisances.lost * all.kept, by_threshold.max(-1.0)],
                    patch: None,
                    weight: each / (p * (1.0 - p)),
                });
            }
        }
    }
    if side.setting.labels {
        let seen = on_vehicle.iter().filter(|(_, points)| **points >= 5.0).map(|(number, _)| *number as usize);
        for number in seen.filter(|number| side.world.vehicles[*number].labelled) {
            sums.labels.extend(label_rows(&frame, &others, number, weight));
        }
    }
    sums
}

/// The label of a vehicle: its error has a part that is the same in all frames.
fn label_rows(frame: &Frame, others: &[Frame], vehicle: usize, weight: f64) -> [Row; 3] {
    let std = frame.side.own.labels_m;
    let here = frame.label_box(vehicle, [0.0; 3]);
    let shifts: Vec<[f64; 3]> =
        others.iter().map(|other| here.to_local(other.label_box(vehicle, [0.0; 3]).center)).collect();
    [0, 1, 2].map(|k| Row {
        columns: shifts.iter().map(|s| -s[k]).collect(),
        frame: vec![],
        patch: Some(((vehicle * 3 + k) as u64, 1.0, TRACK_SHARE * std)),
        weight: weight / ((1.0 - TRACK_SHARE * TRACK_SHARE) * std * std),
    })
}

/// Squared standard errors that a return adds by what is in no other sum.
fn other_information(effect: &Effect, side: &Side, shot: &Shot) -> f64 {
    match *effect {
        Effect::Quantisation { step_m } => 2.0 * (step_m / RESOLUTION_M).max(1.1).ln(),
        Effect::BeamIntensity { .. } => {
            let errors = side.rows[shot.sensor][shot.row].ln_gain / INTENSITY_STD;
            errors * errors
        }
        _ => 0.0,
    }
}

/// The range of a return with its derivatives.
fn mean_row(frame: &Frame, shot: &Shot, echo: &Echo, columns: Vec<f64>, weight: f64) -> Row {
    let pose = frame.sensor_pose(shot.sensor);
    let [normal, ray] = [echo.normal, echo.ray].map(|v| pose.inverse_transform_vector(&v));
    let along = normal.dot(&ray);
    let shift = -normal / along;
    let turn: Vector3<f64> = -ray.cross(&normal) * (echo.range_m / along);
    let at = echo.origin + echo.ray * echo.range_m;
    let (patch, std) = match echo.object {
        Object::House(number) => ((1 << 40) + u64::from(number) * 4 + side_of(&echo.normal), SURFACE_STD_M[0]),
        Object::Ground => {
            let cell = |v: f64| (v / 12.0).floor() as i64 as u64 & 0xffff;
            ((2 << 40) + (cell(at.x) << 16) + cell(at.y), SURFACE_STD_M[1])
        }
        Object::Body(number) => ((3 << 40) + u64::from(number), SURFACE_STD_M[2]),
        Object::Vehicle(number) => ((4 << 40) + u64::from(number) * 4 + side_of(&echo.normal), SURFACE_STD_M[2]),
        Object::Ego => (5 << 40, SURFACE_STD_M[2]),
    };
    Row {
        columns,
        frame: vec![shift.x, shift.y, shift.z, turn.x, turn.y, turn.z, 1.0],
        patch: Some((patch, 1.0 / along, std)),
        weight,
    }
}

/// Which side of a body a normal belongs to.
fn side_of(normal: &Vector3<f64>) -> u64 {
    u64::from(normal.x.abs() > normal.y.abs()) * 2 + u64::from(normal.x + normal.y > 0.0)
}
