//! Ghosts: returns by way of a mirror. They lie behind the surface that reflected their shot.

use super::weather::Air;
use super::{cross_gains, excess, gain, share_of};
use crate::catalogue::sizes::ALONE_SHARE;
use crate::catalogue::{Cause, Channel, Covariate, Quantity};
use crate::channels::mirrors::{Images, behind_frame, images, is_behind};
use crate::channels::returns::{Odd, OddFrame};
use crate::curve::{Curve, CurvePoint};
use crate::diagnosis::{Minimum, Status};
use crate::inference::choice::{significant, total_and_z};
use crate::search::{ChannelResult, Context, Found, Z_STAR, first_demands};
use rayon::prelude::*;

/// Share of the additional returns behind surfaces whose image lies on a surface, beyond chance, from which on mirrors
/// explain them. Most images are not in the cloud: the sensor does not see what faces the mirror alone, and normals of
/// curved surfaces are not known well enough.
const MIRRORED: f64 = 0.15;

/// Their place among the counts of a frame: they are lone returns.
const BEHIND: usize = Odd::Alone as usize;

/// What recording tells mirrors from things behind glass.
const TELL_BY: &str = "the same place from elsewhere: a ghost moves with the sensor, a thing behind glass does not";

/// Whether mirrors explain what lies behind surfaces: more of the images than by chance lie on surfaces, on most
/// frames.
fn are_mirrored(frames: &[Images]) -> bool {
    let each: Vec<f64> = frames.iter().map(|f| f.on_surfaces - f.by_chance).collect();
    let others: f64 = frames.iter().map(|f| f.all - f.by_chance).sum();
    significant(&each, Z_STAR) && each.iter().sum::<f64>() > MIRRORED * others
}

/// Searches ghosts. What lies behind surfaces is then left out by other searches. `air` is of the selecting frames.
pub(super) fn search(
    context: &Context,
    [select, estimate, hold_out]: [&[usize]; 3],
    air: &Air,
    result: &mut ChannelResult,
) -> bool {
    let frames: Vec<OddFrame> = context.frames.par_iter().map(behind_frame).collect();
    let excess_of = |which: &[usize]| excess(which.iter().map(|&i| &frames[i]), BEHIND);
    let gains = cross_gains(&frames, select, &context.blocks(select), BEHIND);
    let (total, z) = total_and_z(&gains);
    let outcome = if total <= first_demands().nats || !significant(&gains, Z_STAR) {
        "no more returns behind surfaces than on the simulated side"
    } else if [select, estimate].into_iter().any(|role| excess_of(role)[1] <= ALONE_SHARE) {
        "too small to speak of"
    } else if !air.mostly_behind() {
        "as many before surfaces: false alarms"
    } else {
        "chosen"
    };
    result.consider(Cause::Ghosts, (total, z), context.returns(select), outcome);
    result.minimum.push((Cause::Ghosts, Minimum::new(Quantity::Share, ALONE_SHARE)));
    if outcome != "chosen" {
        return false;
    }
    let [base, more] = excess_of(estimate);
    let each: Vec<f64> = estimate.iter().map(|&i| excess_of(&[i])[1]).collect();
    let held_out_gains: Vec<f64> = hold_out.iter().map(|&i| gain(&frames[i], BEHIND, base, more)).collect();
    for (d, gain) in result.distance.iter_mut().zip(&held_out_gains) {
        d.iter_mut().for_each(|sum| *sum += gain.max(0.0));
    }
    let of_select: Vec<Images> = select.par_iter().map(|&i| images(&context.frames[i], context.rig)).collect();
    let mirrored = are_mirrored(&of_select);
    let causes = if mirrored { vec![Cause::Ghosts] } else { vec![Cause::Ghosts, Cause::MissingObject] };
    result.found.push(Found {
        effects: vec![],
        status: if mirrored { Status::Named } else { Status::Ambiguous },
        separate_by: (!mirrored).then(|| TELL_BY.into()),
        causes,
        parameters: vec![(Quantity::Share.into(), share_of(more, &each))],
        confidence: (z / (z + 1.0)).clamp(0.0, 1.0),
        channel: Channel::Returns,
        covariate: Covariate::Place,
        held_out_gains,
        says: format!(
            "{:.2} % of the measured returns lie alone behind surfaces and hardly any before them: {}",
            100.0 * more,
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
