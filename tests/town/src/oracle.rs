//! Strength of hidden effects: by how many standard errors an oracle that knows all forms tells each from its absence.
//!
//! Every frame is compared with the same frame without one effect (or a part of one), shot by shot, in what is
//! expected: mean range, variance, probability of a return, returns from elsewhere, labels. Poses of frames and offsets
//! of surfaces are unknown to the oracle within their nuisances, so that correlated frames count less. Some shots of
//! each frame stand for all.

use crate::case::Case;
use crate::effect::Effect;
use crate::evidence::{Products, Residual, Residuals, bernoulli_divergence, poisson_squared_errors};
use crate::frame::{Echo, Frame, Met};
use crate::parts::{Part, Scaling};
use crate::sensor::Shot;
use crate::side::{POSE_STD, Side};
use crate::world::{Object, REACH_M};
use nalgebra::Vector3;
use rayon::prelude::*;
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

/// Time over which small errors of edges and poses are common to frames, s.
const MEMORY_S: f64 = 0.7;

/// Relative scatter of the intensity of returns: speckle and errors of reflectivities.
const INTENSITY_STD: f64 = 0.06;

/// Resolution of a range in which no rounding is seen, m.
const RESOLUTION_M: f64 = 1.5e-3;

/// A part of an effect, and the side without it.
struct Variant {
    effect: usize,
    part: Part,
    side: Side,
}

/// Sums of one effect beside the linear models.
#[derive(Clone, Debug, Default)]
struct Counts {
    divergence: f64,
    moved: f64,
    moved_usual: f64,
    clutter: f64,
    clutter_usual: f64,
    touched: f64,
    other: f64,
}

/// Sums of a frame or of several.
struct Sums {
    residuals: Vec<Residual>,
    variances: Vec<(Vec<f64>, f64)>,
    losses: Vec<(Vec<f64>, f64)>,
    labels: Vec<(Vec<[f64; 3]>, f64)>,
    counts: Vec<Counts>,
    returns: f64,
    shots: f64,
}

/// Judges the hidden effects of a case, in their order.
pub fn judge(case: &Case) -> Vec<Judgement> {
    let side = &case.measured;
    if side.effects.is_empty() {
        return vec![];
    }
    let without = |k: usize, remaining: Option<Effect>| {
        let mut effects = side.effects.clone();
        match remaining {
            Some(effect) => effects[k] = effect,
            None => drop(effects.remove(k)),
        }
        side.with_effects(&case.real_world, effects)
    };
    let variants: Vec<Variant> = side
        .effects
        .iter()
        .enumerate()
        .flat_map(|(k, effect)| effect.parts().into_iter().map(move |part| (k, part)))
        .map(|(effect, part)| Variant { effect, side: without(effect, part.remaining.clone()), part })
        .collect();
    let plain = side.with_effects(&case.real_world, vec![]);
    let every = case.size.frames.div_ceil(FRAMES);
    let chosen: Vec<usize> = (0..case.size.frames).step_by(every).collect();
    let frames: Vec<Sums> = chosen.par_iter().map(|&i| compare(case, &variants, &plain, i, every as f64)).collect();
    let keep = (-side.setting.step_s() * every as f64 / MEMORY_S).exp();
    let independent = (1.0 - keep) / (1.0 + keep);
    let columns = variants.len();
    let mut residuals = Residuals::new(columns);
    let (mut variances, mut losses, mut labels) =
        (Products::new(columns), Products::new(columns), Products::new(columns));
    let mut counts = vec![Counts::default(); side.effects.len()];
    let (mut returns, mut shots) = (0.0, 0.0);
    for frame in &frames {
        residuals.add_frame(&frame.residuals, POSE_STD.map(|std| std / independent.sqrt()));
        frame.variances.iter().for_each(|(row, weight)| variances.add(row, *weight));
        frame.losses.iter().for_each(|(row, weight)| losses.add(row, *weight));
        for (shifts, weight) in &frame.labels {
            (0..3).for_each(|k| labels.add(&shifts.iter().map(|s| s[k]).collect::<Vec<_>>(), *weight));
        }
        for (sum, of_frame) in counts.iter_mut().zip(&frame.counts) {
            sum.add(of_frame);
        }
        (returns, shots) = (returns + frame.returns, shots + frame.shots);
    }
    let [means, variances, labels] = [residuals.products(), variances, labels].map(|products| products.covariance());
    let judgement = |k: usize| {
        let own: Vec<usize> = (0..columns).filter(|&v| variants[v].effect == k).collect();
        let c = &counts[k];
        let lost = own.iter().map(|&v| losses.own_share(v)).fold(1.0, f64::min);
        let squared = means.squared_errors(&own)
            + variances.squared_errors(&own)
            + labels.squared_errors(&own)
            + 2.0 * c.divergence * lost
            + independent * poisson_squared_errors(c.moved, c.moved_usual)
            + poisson_squared_errors(c.clutter + c.clutter_usual, c.clutter_usual)
            + c.other;
        let mut bound = BTreeMap::new();
        for &v in &own {
            let part = &variants[v].part;
            let variance = match part.scaling {
                Scaling::Shift => means.variance(v).or(labels.variance(v)),
                Scaling::Deviation => variances.variance(v).map(|variance| variance / 4.0),
                Scaling::LostShare => Some((1.0 - part.value) / (part.value * returns)),
                Scaling::ClutterShare => Some(1.0 / (part.value * shots)),
                Scaling::Other => None,
            };
            bound.extend(variance.map(|variance| (part.name.to_owned(), part.value.abs() * variance.sqrt())));
        }
        Judgement { strength: squared.max(0.0).sqrt(), touched: c.touched, bound }
    };
    (0..side.effects.len()).map(judgement).collect()
}

impl Counts {
    fn add(&mut self, other: &Counts) {
        self.divergence += other.divergence;
        self.moved += other.moved;
        self.moved_usual += other.moved_usual;
        self.clutter += other.clutter;
        self.clutter_usual += other.clutter_usual;
        self.touched += other.touched;
        self.other += other.other;
    }
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

/// Whether two shots met the same thing at nearly the same place.
fn is_same(a: &Expected, b: &Expected) -> bool {
    match (&a.echo, &b.echo) {
        (Some(x), Some(y)) => x.object == y.object && (a.mean_m - b.mean_m).abs() < ELSEWHERE_M,
        (None, None) => true,
        _ => false,
    }
}

/// Compares a frame with the frames without each part. A frame counts `weight` times.
fn compare(case: &Case, variants: &[Variant], plain: &Side, index: usize, weight: f64) -> Sums {
    let side = &case.measured;
    let frame = Frame::new(side, index);
    let others: Vec<Frame> = variants.iter().map(|v| Frame::new(&v.side, index)).collect();
    let [real, model] = [plain, &case.simulated].map(|side| Frame::new(side, index));
    let mut sums = Sums {
        residuals: vec![],
        variances: vec![],
        losses: vec![],
        labels: vec![],
        counts: vec![Counts::default(); side.effects.len()],
        returns: 0.0,
        shots: 0.0,
    };
    let mut on_vehicle: BTreeMap<u32, f64> = BTreeMap::new();
    let usual = side.nuisances.false_returns;
    for (sensor, mount) in side.mounts.iter().enumerate() {
        let shots = mount.shots(sensor, &side.nuisances.dither, &mut side.stream(&format!("shots {sensor}"), index));
        // A step that is coprime to the number of rows visits all of them.
        let stride = (shots.len() * side.mounts.len()).div_ceil(SHOTS) | 1;
        let each = weight * stride as f64;
        for shot in shots.iter().step_by(stride) {
            let met = frame.trace(shot, [0.0; 2]);
            let all = expected(&frame, shot, &met);
            let is_edge = !is_same(
                &expected(&real, shot, &real.trace(shot, [0.0; 2])),
                &expected(&model, shot, &model.trace(shot, [0.0; 2])),
            );
            sums.shots += each;
            sums.returns += each * all.kept;
            if let Some(Object::Vehicle(number)) = all.echo.map(|e| e.object) {
                *on_vehicle.entry(number).or_default() += all.kept * stride as f64;
            }
            let columns = variants.len();
            let (mut mean, mut variance, mut loss) = (vec![0.0; columns], vec![0.0; columns], vec![0.0; columns]);
            for (v, variant) in variants.iter().enumerate() {
                let effect = &side.effects[variant.effect];
                let met = if effect.changes_rays() { others[v].trace(shot, [0.0; 2]) } else { met };
                let one = expected(&others[v], shot, &met);
                let c = &mut sums.counts[variant.effect];
                // Parts share the counts of their effect.
                let first = v == 0 || variants[v - 1].effect != variant.effect;
                if !is_same(&all, &one) {
                    if first {
                        c.moved += each;
                        c.moved_usual += each * if is_edge { 1.0 } else { 0.003 };
                        c.touched += each * all.kept.max(one.kept);
                    }
                } else if all.echo.is_some() {
                    mean[v] = all.mean_m - one.mean_m;
                    variance[v] = all.variance_m2 - one.variance_m2;
                    loss[v] = all.kept - one.kept;
                    if first {
                        c.divergence += each * bernoulli_divergence(all.kept, one.kept);
                        c.touched += each * (one.kept - all.kept).max(0.0);
                    }
                }
                let more = (all.clutter[0] - one.clutter[0]).max(0.0);
                if first && more > 0.0 {
                    c.clutter += each * more;
                    c.clutter_usual += each * (usual + one.clutter[0]) * (all.clutter[1] / REACH_M).min(1.0);
                    c.touched += each * more;
                }
                if first && all.echo.is_some() {
                    c.other += each * all.kept * other_information(effect, side, shot);
                }
            }
            if let Some(echo) = all.echo.filter(|e| e.normal.dot(&e.ray).abs() > LEAST_COS) {
                let total = all.variance_m2 + side.nuisances.noise_m.powi(2);
                let info = each * all.kept / total;
                sums.residuals.push(residual(&frame, shot, &echo, mean, info));
                let info = 0.5 * each * all.kept / (total * total);
                sums.variances.push((variance, info));
                let p = all.kept.clamp(2e-3, 1.0 - 2e-3);
                sums.losses.push((loss, each / (p * (1.0 - p))));
            }
        }
    }
    if side.setting.labels {
        let info = weight / side.own.labels_m.powi(2);
        for (&number, _) in on_vehicle.iter().filter(|(_, points)| **points >= 5.0) {
            let number = number as usize;
            if side.world.vehicles[number].labelled {
                let here = frame.label_box(number).center;
                let shift = |other: &Frame| {
                    let there = other.label_box(number).center;
                    [0, 1, 2].map(|k| here[k] - there[k])
                };
                sums.labels.push((others.iter().map(shift).collect(), info));
            }
        }
    }
    sums
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

/// A residual with its derivatives.
fn residual(frame: &Frame, shot: &Shot, echo: &Echo, columns: Vec<f64>, weight: f64) -> Residual {
    let pose = frame.sensor_pose(shot.sensor);
    let [normal, ray] = [echo.normal, echo.ray].map(|v| pose.inverse_transform_vector(&v));
    let (along, turn): (f64, Vector3<f64>) = (normal.dot(&ray), ray.cross(&normal));
    let shift = -normal / along;
    let turn = -turn * (echo.range_m / along);
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
    Residual {
        columns,
        pose: [shift.x, shift.y, shift.z, turn.x, turn.y, turn.z],
        patch: (patch, 1.0 / along, std),
        weight,
    }
}

/// Which side of a body a normal belongs to.
fn side_of(normal: &Vector3<f64>) -> u64 {
    u64::from(normal.x.abs() > normal.y.abs()) * 2 + u64::from(normal.x + normal.y > 0.0)
}
