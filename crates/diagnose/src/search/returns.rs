//! Returns too many: false alarms, mixed ranges at edges, things that the simulation has not got.

mod alarms;

use self::alarms::{Alarms, alarms};
use super::{ChannelResult, Context, Found, Z_STAR, parameter};
use crate::channels::returns::{self, ODD, Odd, OddFrame, end_m, odd_frames};
use crate::diagnosis::{Considered, Curve, CurvePoint, Minimum, Parameter, Status};
use crate::inference::choice::{significant, significant_by_signs, total_and_z};
use crate::inference::linear::{FOLDS, fold_of};
use crate::inference::roles::Role;
use crate::pairing::Ray;

/// Share of returns below which nothing is said, by kind.
const FLOORS: [f64; 4] = [0.0008, 0.0006, 0.0015, 0.003];

/// Times as many returns on one side of surfaces as on the other, from which on something was added, or is missing.
const ONE_SIDED: f64 = 3.0;

/// Standard errors, by the signs of frames (ten of ten have more of it), from which on something is seen, and from which on other frames show it again.
const SURE_BY_SIGNS: [f64; 2] = [3.0, 2.0];

/// A beam's width, which follows from what a disc of even light would mix, is known within this factor.
const WIDTH_FACTOR: f64 = 5.0;

/// Widths that beams have, rad.
const WIDTHS_RAD: std::ops::Range<f64> = 1e-5..0.1;

/// The search.
pub fn search(context: &Context) -> ChannelResult {
    let end_m = 0.98 * end_m(context.frames);
    let odd = odd_frames(context.frames, end_m);
    let [select, estimate, hold_out] = [Role::Select, Role::Estimate, Role::HoldOut].map(|r| context.of(r));
    let blocks = context.blocks(&select);
    let mut result = ChannelResult { distance: vec![[0.0; 3]; hold_out.len()], ..ChannelResult::default() };
    let excess_of = |frames: &[usize], kind: usize| excess(frames.iter().map(|&i| &odd[i]), kind);
    for kind in ODD {
        let k = kind as usize;
        let name = name(kind);
        let gains = cross_gains(&odd, &select, &blocks, k);
        let (total, z) = total_and_z(&gains);
        let [base, more] = excess_of(&select, k);
        // How much more there is on each frame by itself.
        let more_on_each = |frames: &[usize]| -> Vec<f64> {
            let share = |i: usize, side: usize| odd[i].counts[k][side] / odd[i].all[side].max(1.0);
            frames.iter().map(|&i| share(i, 0) - share(i, 1)).collect()
        };
        let differences = more_on_each(&select);
        let (_, z_difference) = total_and_z(&differences);
        let error = base.max(more.abs() / 30.0) / z_difference.abs().max(1e-9);
        // Thin things that the simulation has not got, or loses, lie between what it has there, too.
        let floor = FLOORS[k].max(if kind == Odd::Between { 0.5 } else { 0.3 } * base);
        let mut outcome = "no more of them than on the simulated side";
        // What things that are missing on the other side would be.
        let opposite = match kind {
            Odd::GroupInFront => Some(Odd::GroupBehind),
            Odd::GroupBehind => Some(Odd::GroupInFront),
            Odd::Alone | Odd::Between => None,
        };
        // Things stand in few places: what is far more on few frames is not surer by its mean.
        let by_signs = opposite.is_some() && significant_by_signs(&differences, SURE_BY_SIGNS[0]);
        let seen = total > 8.0 && (significant(&gains, Z_STAR) && z_difference > 1.5 || by_signs);
        // Surfaces that only stand elsewhere are missed in one place and found in another.
        let one_sided = opposite.is_none_or(|other| more > ONE_SIDED * excess_of(&select, other as usize)[1].max(0.0));
        if seen && more <= floor {
            outcome = "too small to speak of";
        } else if seen && !one_sided {
            outcome = "as many are missing elsewhere: surfaces stand elsewhere, nothing was added";
        } else if seen {
            outcome = "chosen";
            let [base_e, more_e] = excess_of(&estimate, k);
            let share = share_of(more_e, &more_on_each(&estimate));
            let held: Vec<f64> = hold_out.iter().map(|&i| gain(&odd[i], k, base_e, more_e)).collect();
            result.found.push(found(context, kind, share, held, &odd, &estimate, z, end_m));
            for (d, &i) in result.distance.iter_mut().zip(&hold_out) {
                let (before, after) = distance(&odd[i], k, base_e, more_e);
                *d = [d[0] + before, d[1] + before - after, d[2] + before - after];
            }
        }
        let considered = Considered {
            cause: name.into(),
            channel: "returns".into(),
            nats_per_ray: total / context.returns(&select),
            z,
            outcome: outcome.into(),
        };
        result.considered.push(considered);
        let minimum =
            Minimum { parameter: "share".into(), value: (Z_STAR * error.min(0.1)).max(floor), unit: "1".into() };
        if kind != Odd::GroupBehind {
            result.minimum.push((name.into(), minimum));
        }
    }
    result
}

/// Nats a return that groups of returns gain where surfaces stand elsewhere, and the share of it that is left at most where they were moved to their place.
const ELSEWHERE: [f64; 2] = [0.01, 0.5];

/// Whether a scene that was moved comes to lie where the simulation has something.
pub fn comes_to_lie(before: &Context, moved: &Context) -> bool {
    let [before, after] = [before, moved].map(elsewhere);
    before > ELSEWHERE[0] && after < ELSEWHERE[1] * before
}

/// What returns gain that lie together where the other side has nothing, nats a return: things that only one side has, or surfaces that stand elsewhere.
fn elsewhere(context: &Context) -> f64 {
    let odd = odd_frames(context.frames, 0.98 * end_m(context.frames));
    let select = context.of(Role::Select);
    let blocks = context.blocks(&select);
    let gain = |kind: Odd| cross_gains(&odd, &select, &blocks, kind as usize).iter().sum::<f64>().max(0.0);
    (gain(Odd::GroupInFront) + gain(Odd::GroupBehind)) / context.returns(&select).max(1.0)
}

fn name(kind: Odd) -> &'static str {
    match kind {
        Odd::Alone => "outliers",
        Odd::Between => "mixed_pixels",
        Odd::GroupInFront | Odd::GroupBehind => "missing_object",
    }
}

/// Share on the simulated side, and how much more the measured side has.
fn excess<'a>(frames: impl Iterator<Item = &'a OddFrame>, k: usize) -> [f64; 2] {
    let mut sum = [0.0; 4];
    for f in frames {
        for (s, v) in sum.iter_mut().zip([f.counts[k][0], f.counts[k][1], f.all[0], f.all[1]]) {
            *s += v;
        }
    }
    let base = (sum[1] + 0.5) / sum[3].max(1.0);
    [base, sum[0] / sum[2].max(1.0) - base]
}

/// How much more there is, with its interval, from how much more there is on each frame; in logarithms where few frames have most of it.
fn share_of(more: f64, each: &[f64]) -> Parameter {
    let (_, z) = total_and_z(each);
    let error = (more.abs() / z.abs().max(1e-9)).hypot(0.05 * more);
    let mut share = parameter("share", more, error, "1").1;
    if share.ci95[0] * share.ci95[1] <= 0.0 && more > 0.0 && significant_by_signs(each, SURE_BY_SIGNS[1]) {
        let factor = (1.96 * error / more).exp();
        share.ci95 = [more / factor, more * factor];
    }
    share
}

/// Gain of a frame's count, nats.
fn gain(frame: &OddFrame, k: usize, base: f64, more: f64) -> f64 {
    let rate = (base + more).max(0.05 * base);
    frame.counts[k][0] * (rate / base).ln() - frame.all[0] * (rate - base)
}

/// Distance of a frame's count from the simulated share, and from that with what was found.
fn distance(frame: &OddFrame, k: usize, base: f64, more: f64) -> (f64, f64) {
    let n = frame.counts[k][0];
    let from = |rate: f64| {
        let expected = frame.all[0] * rate.max(1e-9);
        (if n > 0.0 { n * (n / expected).ln() } else { 0.0 }) - (n - expected)
    };
    (from(base), from((base + more).max(0.05 * base)))
}

fn cross_gains(odd: &[OddFrame], select: &[usize], blocks: &[usize], k: usize) -> Vec<f64> {
    let folds = fold_of(blocks);
    let mut gains = vec![0.0; select.len()];
    for fold in 0..FOLDS {
        let train = (0..select.len()).filter(|&i| folds[i] != fold).map(|i| &odd[select[i]]);
        let [base, more] = excess(train, k);
        for i in (0..select.len()).filter(|&i| folds[i] == fold) {
            gains[i] = gain(&odd[select[i]], k, base, more.max(0.0));
        }
    }
    gains
}

#[expect(clippy::too_many_arguments, reason = "the parts of a finding")]
fn found(
    context: &Context,
    kind: Odd,
    share: Parameter,
    held_out_gains: Vec<f64>,
    odd: &[OddFrame],
    estimate: &[usize],
    z: f64,
    end_m: f64,
) -> Found {
    let name = name(kind);
    let (more, error) = (share.estimate, (share.ci95[1] - share.ci95[0]) / 2.0 / 1.96);
    let mut parameters = vec![];
    let sum = |f: fn(&OddFrame) -> f64| estimate.iter().map(|&i| f(&odd[i])).sum::<f64>();
    let (covariate, says) = match kind {
        Odd::Alone => {
            let Alarms { rate, reach_m } = alarms(context, estimate, end_m);
            let form = (error / more.abs().max(1e-9)).hypot(0.06);
            parameters.push(parameter("rate", rate, form * rate, "1"));
            parameters.push(parameter("reach_m", reach_m, 0.05 * reach_m, "m"));
            (
                "none",
                format!(
                    "{:.2} % of the measured returns stand alone where nothing is: false alarms, of {:.2} % of the shots, that your simulator does not make",
                    100.0 * more,
                    100.0 * rate
                ),
            )
        }
        Odd::Between => {
            parameters.push(("share".into(), share));
            let width = more * sum(|f| f.all[0]) / sum(|f| f.mixed_per_rad);
            // How a sensor weighs what a beam meets is not known.
            let so_wide = if WIDTHS_RAD.contains(&width) {
                let ci95 = [width / WIDTH_FACTOR, width * WIDTH_FACTOR];
                parameters.push(("divergence_rad".into(), Parameter { estimate: width, unit: "rad".into(), ci95 }));
                format!(", about {:.1} mrad", 1e3 * width)
            } else {
                String::new()
            };
            (
                "edge",
                format!(
                    "{:.2} % of the measured returns lie between the two surfaces of an edge: beams have a width{so_wide}, your simulator's are lines",
                    100.0 * more
                ),
            )
        }
        Odd::GroupInFront => {
            parameters.push(("share".into(), share));
            (
                "place",
                format!(
                    "{:.2} % of the measured returns lie together where the simulation has nothing: things are missing in it",
                    100.0 * more
                ),
            )
        }
        Odd::GroupBehind => {
            let [low, high] = share.ci95;
            parameters.push(("share".into(), Parameter { estimate: -more, ci95: [-high, -low], ..share }));
            (
                "place",
                format!(
                    "{:.2} % of the measured returns lie together behind what the simulation has there: it has things that are not on the road",
                    100.0 * more
                ),
            )
        }
    };
    let family = if matches!(kind, Odd::Alone | Odd::Between) { "returns" } else { "geometry" };
    Found {
        status: Status::Named,
        causes: vec![name.into()],
        family,
        parameters,
        confidence: (z / (z + 1.0)).clamp(0.0, 1.0),
        channel: "returns",
        covariate: covariate.into(),
        held_out_gains,
        says,
        separate_by: None,
        curve: curve(context, kind, estimate),
    }
}

/// Share of such returns by range.
fn curve(context: &Context, kind: Odd, frames: &[usize]) -> Curve {
    const BINS: usize = 12;
    let bin = |r: &Ray| ((r.own_range_m() / 10.0) as usize).min(BINS - 1);
    let mut counts = [[0.0f64; BINS]; 4];
    for &f in frames {
        for (side, rays) in [&context.frames[f].measured, &context.frames[f].simulated].into_iter().enumerate() {
            for ray in rays {
                counts[2 * side][bin(ray)] += 1.0;
                if returns::odd(ray) == Some(kind) {
                    counts[2 * side + 1][bin(ray)] += 1.0;
                }
            }
        }
    }
    let total: [f64; 2] = [0, 2].map(|k: usize| counts[k].iter().sum::<f64>().max(1.0));
    let points = (0..BINS).map(|b| CurvePoint {
        x: 10.0 * b as f64 + 5.0,
        measured: counts[1][b] / total[0],
        before: counts[3][b] / total[1],
        after: counts[1][b] / total[0],
        error: counts[1][b].sqrt() / total[0],
    });
    Curve { x: "range, m".into(), y: "share of all returns".into(), points: points.collect() }
}
