//! Ghosts: returns by way of a mirror. They lie behind the surface that reflected their shot.

use super::false_alarms::mostly_behind;
use super::{FLOORS, share_of};
use crate::catalogue::{Cause, Channel, Covariate, Quantity};
use crate::channels::mirrors::{MirrorFrame, is_behind, mirror_frame};
use crate::channels::returns::Odd;
use crate::curve::{Curve, CurvePoint};
use crate::diagnosis::{Considered, Minimum, Status};
use crate::inference::choice::{significant, total_and_z};
use crate::inference::gain_of_count;
use crate::inference::linear::cross_validated;
use crate::search::{ChannelResult, Context, Found, Z_STAR, first_demands};
use rayon::prelude::*;

/// Share of the additional returns behind surfaces whose image lies on a surface, beyond chance, from which on mirrors
/// explain them. Most images are not in the cloud: the sensor does not see what faces the mirror alone, and normals of
/// curved surfaces are not known well enough.
const MIRRORED: f64 = 0.15;

/// Smallest share of all returns that is reported: that of lone returns.
const FLOOR: f64 = FLOORS[Odd::Alone as usize];

/// What recording tells mirrors from things behind glass.
const TELL_BY: &str = "the same place from elsewhere: a ghost moves with the sensor, a thing behind glass does not";

/// Share of the returns of a side over some frames that a number counts.
fn share_on(frames: &[&MirrorFrame], side: usize, number: fn(&MirrorFrame, usize) -> f64) -> f64 {
    let sum = |of: &dyn Fn(&MirrorFrame) -> f64| frames.iter().map(|f| of(f)).sum::<f64>();
    sum(&|f| number(f, side)) / sum(&|f| f.all[side]).max(1.0)
}

/// Returns behind surfaces: the simulated share, and the excess of the measured side over it.
fn excess(frames: &[&MirrorFrame]) -> [f64; 2] {
    let all: f64 = frames.iter().map(|f| f.all[1]).sum();
    let [measured, simulated] = [0, 1].map(|side| share_on(frames, side, |f, side| f.behind[side]));
    let base = simulated + 0.5 / all.max(1.0);
    [base, measured - base]
}

/// Gain of a frame's returns behind surfaces, nats.
fn gain(frame: &MirrorFrame, [base, more]: [f64; 2]) -> f64 {
    gain_of_count(frame.behind[0], frame.all[0], base + more.max(0.0), base)
}

/// Whether mirrors explain what lies behind surfaces: more of the images than by chance lie on surfaces, on most
/// frames.
fn are_mirrored(frames: &[&MirrorFrame]) -> bool {
    let images = |f: &&MirrorFrame| f.mirrored[0] - f.by_chance[0];
    let each: Vec<f64> = frames.iter().map(images).collect();
    let others: f64 = frames.iter().map(|f| f.behind[0] - f.by_chance[0]).sum();
    significant(&each, Z_STAR) && each.iter().sum::<f64>() > MIRRORED * others
}

/// Searches ghosts. What lies behind surfaces is then left out by other searches.
pub(super) fn search(
    context: &Context,
    [select, estimate, hold_out]: [&[usize]; 3],
    end_m: f64,
    result: &mut ChannelResult,
) -> bool {
    let frames: Vec<MirrorFrame> = context.frames.par_iter().map(|f| mirror_frame(f, context.rig)).collect();
    let of = |which: &[usize]| which.iter().map(|&i| &frames[i]).collect::<Vec<_>>();
    let selected = of(select);
    let fit = |train: &[usize]| excess(&train.iter().map(|&i| selected[i]).collect::<Vec<_>>());
    let gains = cross_validated(&context.blocks(select), fit, |rates, i| gain(selected[i], *rates));
    let (total, z) = total_and_z(&gains);
    let outcome = if total <= first_demands().nats || !significant(&gains, Z_STAR) {
        "no more returns behind surfaces than on the simulated side"
    } else if [select, estimate].into_iter().any(|role| excess(&of(role))[1] <= FLOOR) {
        "too small to speak of"
    } else if !mostly_behind(context, select, end_m) {
        "as many before surfaces: false alarms"
    } else {
        "chosen"
    };
    result.considered.push(Considered {
        cause: Cause::Ghosts.into(),
        channel: Channel::Returns,
        nats_per_ray: total / context.returns(select).max(1.0),
        z,
        outcome: outcome.into(),
    });
    result.minimum.push((Cause::Ghosts, Minimum::new(Quantity::Share, FLOOR)));
    if outcome != "chosen" {
        return false;
    }
    let rates = excess(&of(estimate));
    let each: Vec<f64> = estimate.iter().map(|&i| excess(&[&frames[i]])[1]).collect();
    let held_out_gains: Vec<f64> = hold_out.iter().map(|&i| gain(&frames[i], rates)).collect();
    for (d, gain) in result.distance.iter_mut().zip(&held_out_gains) {
        d.iter_mut().for_each(|sum| *sum += gain.max(0.0));
    }
    let mirrored = are_mirrored(&selected);
    let causes = if mirrored { vec![Cause::Ghosts] } else { vec![Cause::Ghosts, Cause::MissingObject] };
    result.found.push(Found {
        effects: vec![],
        status: if mirrored { Status::Named } else { Status::Ambiguous },
        separate_by: (!mirrored).then(|| TELL_BY.into()),
        causes,
        parameters: vec![(Quantity::Share.into(), share_of(rates[1], &each))],
        confidence: (z / (z + 1.0)).clamp(0.0, 1.0),
        channel: Channel::Returns,
        covariate: Covariate::Place,
        held_out_gains,
        says: format!(
            "{:.2} % of the measured returns lie alone behind surfaces and hardly any before them: {}",
            100.0 * rates[1],
            if mirrored {
                "ghosts, in places where a mirror shows other surfaces"
            } else {
                "ghosts, or things behind glass"
            }
        ),
        curve: curve(context, estimate),
    });
    true
}

/// Share of returns behind surfaces by their distance from the surface.
fn curve(context: &Context, frames: &[usize]) -> Curve {
    const BINS: usize = 12;
    const WIDTH_M: f64 = 5.0;
    let mut counts = [[0.0f64; BINS]; 2];
    let mut all = [0.0f64; 2];
    for &f in frames {
        for (side, rays) in [&context.frames[f].measured, &context.frames[f].simulated].into_iter().enumerate() {
            all[side] += rays.len() as f64;
            for ray in rays.iter().filter(|ray| is_behind(ray)) {
                counts[side][((f64::from(ray.residual_m) / WIDTH_M) as usize).min(BINS - 1)] += 1.0;
            }
        }
    }
    let share = |side: usize, bin: usize| counts[side][bin] / all[side].max(1.0);
    let points = (0..BINS).map(|bin| CurvePoint {
        sensor: 0,
        x: WIDTH_M * (bin as f64 + 0.5),
        measured: share(0, bin),
        before: share(1, bin),
        after: share(0, bin),
        error: counts[0][bin].sqrt() / all[0].max(1.0),
    });
    Curve {
        x: "distance behind the surface, m".into(),
        y: "share of all returns".into(),
        by_sensor: false,
        points: points.collect(),
    }
}
