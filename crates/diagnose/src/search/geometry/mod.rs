//! Where surfaces lie: biases of range, poses of sensors and car, rows that aim or measure wrongly, and what has no name.

mod agreed;
mod curve;
mod displacement;
mod floor;
mod rows;
mod suspects;
mod words;

pub use self::displacement::Displacement;

use self::agreed::agreed_turns;
use self::displacement::displacement;
use self::floor::above_floor;
use self::rows::surer_rows;
use self::suspects::{Suspect, is_pose, may_join, suspects};
use super::{ChannelResult, Context, first_demands, record, unless_unsure};
use crate::channels::groups::{GroupFrame, Grouping, PartedFrame, group_frames, total, whole};
use crate::channels::mean::{
    Column, MeanFrame, OWN, OwnPoses, STRUCTURE_M, columns, design_effect, mean_frames, origins, own_poses,
    usual_noise_m,
};
use crate::diagnosis::Considered;
use crate::inference::choice::{Trial, choose, total_and_z};
use crate::inference::grouped::{self, GroupFit};
use crate::inference::linear::{LinearFit, LinearFrame, cross_gains, fit};
use crate::inference::median;
use crate::inference::roles::Role;
use nalgebra::SVector;
use rayon::prelude::*;
use sensor::Rig;

/// Share of a pose's gain that a second pose must bring.
const A_SECOND_POSE: f64 = 0.3;

/// Everything that candidates are weighed on.
struct Sums {
    columns: Vec<Column>,
    precision: Vec<f64>,
    base: Vec<usize>,
    linear: Vec<LinearFrame>,
    rows: Groups,
    strips: Groups,
    poses: Vec<OwnPoses>,
    /// Weights of all returns of each sensor, by frame.
    of_sensors: Vec<Vec<f64>>,
}

/// Groups of every frame, by part and whole.
struct Groups {
    parted: Vec<PartedFrame>,
    whole: Vec<GroupFrame>,
}

/// The search; also what is to be taken out for the others.
pub fn search(context: &Context) -> (ChannelResult, Displacement) {
    let [select, estimate, hold_out] = [Role::Select, Role::Estimate, Role::HoldOut].map(|r| context.of(r));
    let mut result = ChannelResult { distance: vec![[0.0; 3]; hold_out.len()], ..ChannelResult::default() };
    let sums = sums(context, &select);
    let blocks = context.blocks(&select);
    let returns = context.returns(&select);
    let demands = first_demands();
    let all = suspects(context, &sums.columns);
    let mut chosen: Vec<Suspect> = Vec::new();
    let mut stories = Vec::new();
    let mut first_gains: Vec<f64> = Vec::new();
    for step in 0..2 {
        let candidates: Vec<&Suspect> = all.iter().filter(|s| may_join(s, &chosen)).collect();
        let before = gains(&sums, &select, &blocks, &chosen);
        let mut trials: Vec<Trial> = candidates
            .par_iter()
            .enumerate()
            .map(|(k, suspect)| {
                let with: Vec<Suspect> = chosen.iter().cloned().chain([(*suspect).clone()]).collect();
                let mut g = gains(&sums, &select, &blocks, &with);
                g.iter_mut().zip(&before).for_each(|(g, b)| *g -= b);
                let again = is_pose(suspect) && chosen.iter().any(is_pose);
                let enough = !again || total_and_z(&g).0 > A_SECOND_POSE * first_gains.iter().sum::<f64>();
                Trial {
                    candidate: k,
                    name: suspect.name().into(),
                    parameters: suspect.parameters(),
                    gains: g,
                    above_floor: enough && above_floor(&sums, &select, &blocks, &with),
                }
            })
            .collect();
        surer_rows(&mut trials, &candidates);
        if step > 0 {
            // What is left of the first gains little; what is surer than the first by itself is none of it.
            let first = total_and_z(&first_gains);
            trials.iter_mut().for_each(|t| {
                let (total, z) = total_and_z(&t.gains);
                t.above_floor &= total > 0.1 * first.0 || z > first.1 && total > 0.02 * first.0;
            });
        }
        let choice = choose(&trials, &demands);
        result.considered.extend(record(&trials, choice.as_ref(), "residuals", returns, &demands));
        if step == 0 {
            result.minimum = words::minimum(&sums, &select, &blocks);
        }
        let Some(choice) = choice else { break };
        let t = &trials[choice.chosen];
        first_gains.clone_from(&t.gains);
        let mut equals: Vec<String> = choice.equals.iter().map(|&i| trials[i].name.clone()).collect();
        equals.sort();
        equals.dedup();
        stories.push(unless_unsure(equals, &trials, &blocks, &t.name, &demands));
        chosen.push(candidates[t.candidate].clone());
    }
    if let Some(suspect) = agreed_turns(&sums, &select, &blocks, &chosen) {
        let with: Vec<Suspect> = chosen.iter().cloned().chain([suspect.clone()]).collect();
        let before = gains(&sums, &select, &blocks, &chosen);
        let more: Vec<f64> = gains(&sums, &select, &blocks, &with).iter().zip(&before).map(|(g, b)| g - b).collect();
        let (total, z) = total_and_z(&more);
        if total > demands.nats && z > demands.z && above_floor(&sums, &select, &blocks, &with) {
            result.considered.push(Considered {
                cause: suspect.name().into(),
                channel: "residuals".into(),
                nats_per_ray: total / returns,
                z,
                outcome: "chosen: all other sensors see it alike".into(),
            });
            chosen.push(suspect);
            stories.push((vec![], 1.0));
        }
    }
    let estimate_blocks = context.blocks(&estimate);
    // What is chosen must be worth speaking of on the frames that say how large it is.
    let spoken: Vec<bool> = (0..chosen.len())
        .map(|k| {
            let last: Vec<Suspect> =
                (0..chosen.len()).filter(|i| *i != k).chain([k]).map(|i| chosen[i].clone()).collect();
            matches!(chosen[k], Suspect::Groups { .. }) || above_floor(&sums, &estimate, &estimate_blocks, &last)
        })
        .collect();
    let kept = chosen.into_iter().zip(stories).zip(spoken).filter(|(_, spoken)| *spoken).map(|(both, _)| both);
    let (chosen, stories): (Vec<Suspect>, Vec<_>) = kept.unzip();
    for (k, (equals, confidence)) in stories.into_iter().enumerate() {
        let alone = &chosen[k];
        let held: Vec<f64> =
            hold_out.iter().map(|&f| told(&sums, &estimate, &estimate_blocks, alone, &chosen, f)).collect();
        result.found.push(words::found(
            context,
            &sums,
            &estimate,
            &estimate_blocks,
            alone,
            &chosen,
            equals,
            confidence,
            held,
        ));
    }
    let every = everything(&sums, &estimate, &estimate_blocks);
    for (i, &f) in hold_out.iter().enumerate() {
        let each: Vec<(bool, f64)> = chosen
            .iter()
            .map(|s| (matches!(s, Suspect::Groups { .. }), told(&sums, &estimate, &estimate_blocks, s, &chosen, f)))
            .collect();
        let gain: f64 = each.iter().map(|e| e.1).sum();
        let groups: f64 = each.iter().filter(|e| e.0).map(|e| e.1).sum();
        let best = every.0.gain(&sums.linear[f]) - every.1.gain(&sums.linear[f]) + groups.max(0.0);
        // The sums have no distance of their own: it is what they could gain at most.
        result.distance[i] = [best.max(gain).max(0.0), gain, best];
    }
    let out = displacement(context.rig, &sums, &select, &blocks, &chosen);
    (result, out)
}

fn sums(context: &Context, select: &[usize]) -> Sums {
    let (frames, rig) = (context.frames, context.rig);
    let origins = origins(rig);
    let noise_m = usual_noise_m(frames);
    let poses: Vec<OwnPoses> = frames.par_iter().map(|f| own_poses(f, &origins, noise_m)).collect();
    let design = design_effect(frames, &origins, &poses, noise_m);
    let columns = columns(rig);
    let means: Vec<MeanFrame> = mean_frames(frames, rig, &columns, &poses, noise_m, design);
    let prior = own_scatter(rig, &poses, select);
    // The normals of surfaces have the length 1: squares of levers of shifts make the weights.
    let shift_of = |c: &Column, s: usize| matches!(c, Column::SensorPose(of, 3..6) if *of == s);
    let of_sensor = |m: &MeanFrame, s: usize| {
        let shifts = (0..columns.len()).filter(|&c| shift_of(&columns[c], s));
        shifts.map(|c| m.gram[(c, c)]).sum::<f64>()
    };
    let of_sensors = means.iter().map(|m| (0..rig.sensors.len()).map(|s| of_sensor(m, s)).collect()).collect();
    let linear: Vec<LinearFrame> = means
        .iter()
        .map(|m| {
            let (gram, right) = m.without_own(&prior);
            LinearFrame { gram, right }
        })
        .collect();
    let precision: Vec<f64> = columns
        .iter()
        .map(|c| {
            let sd: f64 = match c {
                Column::RangeOffset => 0.5,
                Column::RangeScale => 0.02,
                Column::Pose(k) | Column::SensorPose(_, k) => {
                    if *k < 3 {
                        0.035
                    } else {
                        0.2
                    }
                }
                Column::Sweep(k) => {
                    if *k < 2 {
                        8.0
                    } else {
                        0.2
                    }
                }
                Column::Structure(_) => STRUCTURE_M,
            };
            1.0 / (sd * sd)
        })
        .collect();
    let base: Vec<usize> = (0..columns.len()).filter(|&i| matches!(columns[i], Column::Structure(_))).collect();
    let selected: Vec<&LinearFrame> = select.iter().map(|&i| &linear[i]).collect();
    let structure = fit(&selected, &context.blocks(select), &base, &precision);
    let structure = std::array::from_fn(|k| structure.theta[k]);
    let groups = |g| {
        let parted = group_frames(frames, rig, &poses, structure, g, noise_m, design);
        Groups { whole: parted.iter().map(whole).collect(), parted }
    };
    Sums {
        rows: groups(Grouping::Row),
        strips: groups(Grouping::Azimuth),
        columns,
        precision,
        base,
        linear,
        poses,
        of_sensors,
    }
}

/// Variances of what every frame may have of its own: of its pose as they scatter, robust, about the mean of each sensor; of its slide as cars drive,
/// where a scan takes row after row: what stands slides along columns then, unlike anything else but a little like a sensor's pose.
fn own_scatter(rig: &Rig, poses: &[OwnPoses], select: &[usize]) -> SVector<f64, OWN> {
    let least = [2e-5, 2e-5, 2e-5, 5e-4, 5e-4, 5e-4];
    let scatter = |k: usize| {
        let mut deviations = Vec::new();
        for sensor in 0..poses.first().map_or(0, Vec::len) {
            let values: Vec<f64> = select.iter().map(|&f| poses[f][sensor][k]).collect();
            let middle = median(values.clone());
            deviations.extend(values.iter().map(|v| (v - middle).abs()));
        }
        (median(deviations) / 0.6745).max(least[k])
    };
    let by_rows = rig.sensors.iter().find(|s| !s.rows_in_turn().is_empty());
    let slide = |k: usize| by_rows.map_or(0.0, |s| OWN_MOTION[k] / s.rate_hz);
    SVector::from_fn(|k, _| if k < 6 { scatter(k) } else { slide(k - 6) }.powi(2))
}

/// How cars drive: along, across (m/s), turns (rad/s).
const OWN_MOTION: [f64; 3] = [40.0, 3.0, 0.3];

fn split(suspects: &[Suspect]) -> (Vec<usize>, Vec<(Grouping, usize)>) {
    let mut columns: Vec<usize> = Vec::new();
    let mut groups = Vec::new();
    for s in suspects {
        match s {
            Suspect::Linear { columns: own, .. } => {
                for &c in own {
                    if !columns.contains(&c) {
                        columns.push(c);
                    }
                }
            }
            Suspect::Groups { grouping, column, .. } => groups.push((*grouping, *column)),
        }
    }
    (columns, groups)
}

/// Gains over structures that are a little wrong, fitted on other folds.
fn gains(sums: &Sums, select: &[usize], blocks: &[usize], suspects: &[Suspect]) -> Vec<f64> {
    let (columns, groups) = split(suspects);
    let mut out = vec![0.0; select.len()];
    if !columns.is_empty() {
        let frames: Vec<&LinearFrame> = select.iter().map(|&i| &sums.linear[i]).collect();
        let with: Vec<usize> = sums.base.iter().chain(&columns).copied().collect();
        let base = cross_gains(&frames, blocks, &sums.base, &sums.precision);
        let all = cross_gains(&frames, blocks, &with, &sums.precision);
        (0..out.len()).for_each(|i| out[i] += all[i] - base[i]);
    }
    for (grouping, column) in groups {
        let parted = if grouping == Grouping::Row { &sums.rows.parted } else { &sums.strips.parted };
        let more = grouped::cross_part_gains(parted, select, blocks, how(column), grouping == Grouping::Row);
        out.iter_mut().zip(more).for_each(|(o, g)| *o += g);
    }
    out
}

fn groups_of(sums: &Sums, grouping: Grouping) -> &[GroupFrame] {
    if grouping == Grouping::Row { &sums.rows.whole } else { &sums.strips.whole }
}

/// Prior spread of offsets: 10 cm, 0.3 degrees.
fn how(column: usize) -> GroupFit {
    GroupFit { column, precision: [1.0 / (0.1 * 0.1), 1.0 / (0.0052 * 0.0052)][column], centred: true, trust: 1.0 }
}

fn fit_all(sums: &Sums, frames: &[usize], blocks: &[usize], suspects: &[Suspect]) -> LinearFit {
    let (columns, _) = split(suspects);
    let with: Vec<usize> = sums.base.iter().chain(&columns).copied().collect();
    let frames: Vec<&LinearFrame> = frames.iter().map(|&i| &sums.linear[i]).collect();
    fit(&frames, blocks, &with, &sums.precision)
}

/// Gain of one frame by one of the chosen, fitted on `estimate`.
fn told(sums: &Sums, estimate: &[usize], blocks: &[usize], suspect: &Suspect, chosen: &[Suspect], frame: usize) -> f64 {
    match suspect {
        Suspect::Linear { columns, .. } => {
            let fitted = fit_all(sums, estimate, blocks, chosen);
            let mut without = fitted.clone();
            for (i, c) in fitted.columns.iter().enumerate() {
                if columns.contains(c) {
                    without.theta[i] = 0.0;
                }
            }
            fitted.gain(&sums.linear[frame]) - without.gain(&sums.linear[frame])
        }
        Suspect::Groups { grouping, column, .. } => {
            let frames = groups_of(sums, *grouping);
            let offsets = grouped::offsets(&total(estimate.iter().map(|&i| &frames[i])), how(*column));
            grouped::gain(&frames[frame], *column, &offsets)
        }
    }
}

/// Fits of all columns and of the structures alone.
fn everything(sums: &Sums, frames: &[usize], blocks: &[usize]) -> (LinearFit, LinearFit) {
    let frames: Vec<&LinearFrame> = frames.iter().map(|&i| &sums.linear[i]).collect();
    let all: Vec<usize> = (0..sums.columns.len()).collect();
    (fit(&frames, blocks, &all, &sums.precision), fit(&frames, blocks, &sums.base, &sums.precision))
}
