//! Noise with heavy tails: single returns that are much farther off than the others.

use super::mixture::{Fit, Mixture};
use crate::catalogue::sizes::{TAILS_MORE, TAILS_SHARE};
use crate::catalogue::{Cause, Channel, Covariate, Quantity};
use crate::channels::roughness::{CAP, RoughFrame};
use crate::channels::tails::{BEYOND, FrameTails, Tail, most_m, tails};
use crate::curve::{Curve, CurvePoint};
use crate::diagnosis::{Minimum, Status};
use crate::effects::rounded;
use crate::inference::choice::{significant, total_and_z};
use crate::inference::linear::cross_validated;
use crate::inference::roles::Role;
use crate::pairing::STRAY_M;
use crate::search::{ChannelResult, Context, Found, Z_STAR, parameter};
use rayon::prelude::*;
use sensor::Effect;
use sensor::effects::HeavyTails;
use statistics::{blocks_of, deviation, draw_blocks};

/// Least evidence on the selecting and on the estimating frames, nats. Of 20 pairs of the second generator without
/// heavy tails one had more than 8 on both, 11.6 and 14.5.
const LEAST_NATS: f64 = 12.0;

/// Relative error of share and standard deviation by the law: errors of sensors have neither of both.
const OF_FORM: f64 = 0.1;

/// Share of tails right after one from which on shots are not independent: noise that depends on the surface is large
/// on a dark surface, shot after shot. The surface through the neighbours of a far return is drawn to it, so that some
/// of them are far from it as well.
const INDEPENDENT: f64 = 0.3;

/// Mean variance of the surfaces by which measured roughness is taken, in units of that of one range.
fn leverage(context: &Context) -> f64 {
    let rough = context.frames.iter().flat_map(|f| &f.measured).filter(|r| r.roughness_m.is_finite());
    let (n, sum) = rough.fold((0.0, 0.0), |(n, sum), r| (n + 1.0, sum + f64::from(r.roughness_leverage)));
    sum / f64::max(n, 1.0)
}

/// Searches heavy tails. What is found is taken out of the sums of the measured roughness. Returns the variance by
/// which it draws the surfaces through the neighbours of what is far off, m2; 0 where nothing is found.
pub(super) fn search(context: &Context, rough: &mut [RoughFrame], scales: &[f64], result: &mut ChannelResult) -> f64 {
    let [select, estimate, hold_out] = [Role::Select, Role::Estimate, Role::HoldOut].map(|r| context.of(r));
    let all = tails(context.frames, scales);
    let tail = |which: &[usize]| which.iter().map(|&i| &all[i]).collect::<Vec<_>>();
    let on_select = tail(&select);
    let leverage = leverage(context);
    let on_estimate = tail(&estimate);
    let [fitted, on_others] = [&on_select, &on_estimate].map(|tails| Fit::of(tails));
    let gains = cross_gains(&on_select, &context.blocks(&select));
    let [evidence, again] = [fitted, on_others].map(|fit| fit.map_or(0.0, |fit| fit.evidence));
    let (_, z) = total_and_z(&gains);
    let [base, share] = fitted.map_or([0.0; 2], |fit| fit.shares(&on_select));
    let std_m = fitted.map_or(0.0, |fit| fit.mixture.std_m);
    let clustered = clustering(&on_select);
    let mut errors = [0.0; 2];
    let outcome = if evidence.min(again) < LEAST_NATS || !significant(&gains, Z_STAR) {
        "no more of them than on the simulated side, but for what is spread evenly about surfaces"
    } else if share < TAILS_SHARE.max(TAILS_MORE * base) {
        "too few to speak of"
    } else if std_m > STRAY_M {
        "spread evenly around surfaces: droplets or false alarms"
    } else if clustered > INDEPENDENT {
        "the next shot is as far off: noise that depends on the surface"
    } else {
        errors = on_others.map_or(errors, |fit| errors_of(&fit, &on_estimate, &context.blocks(&estimate)));
        let sure = on_others.is_some_and(|fit| fit.numbers[0] > 1.96 * errors[0]);
        if sure { "chosen" } else { "there may be none" }
    };
    result.consider(Cause::HeavyTails, (evidence, z), context.returns(&select), outcome);
    result.minimum.push((Cause::HeavyTails, Minimum::new(Quantity::Share, TAILS_SHARE.max(TAILS_MORE * base))));
    let Some(fitted) = on_others else { return 0.0 };
    if outcome != "chosen" {
        if clustered <= INDEPENDENT {
            take_out(rough, scales, fitted.without, leverage);
        }
        return 0.0;
    }
    let held: Vec<f64> = tail(&hold_out).iter().map(|t| fitted.gain(t)).collect();
    for (d, gain) in result.distance.iter_mut().zip(&held) {
        *d = [d[0] + gain.max(0.0), d[1] + gain, d[2] + gain];
    }
    take_out(rough, scales, fitted.mixture, leverage);
    // The simulator has normal errors.
    let Mixture { share, std_m, .. } = fitted.normal;
    let effect = Effect::HeavyTails(HeavyTails { probability: rounded(share, 6), std_m: rounded(std_m, 4) });
    result.found.push(Found { effects: vec![effect], ..describe(fitted.numbers, errors, &on_estimate, held, z) });
    leverage * fitted.mixture.share * fitted.mixture.std_m.powi(2)
}

/// Shares of the simulated and of the measured returns in the tail.
fn shares(tails: &[&FrameTails]) -> [f64; 2] {
    let share = |side: usize| {
        let sum = |of: fn(&Tail) -> f64| tails.iter().copied().flatten().map(|t| of(&t[side])).sum::<f64>();
        (sum(|t| t.beyond) + 0.5) / sum(|t| t.all).max(1.0)
    };
    [share(1), share(0)]
}

/// Cross-validated gains of the selecting frames, nats: tails are in all frames.
fn cross_gains(tails: &[&FrameTails], blocks: &[usize]) -> Vec<f64> {
    let fit = |train: &[usize]| Fit::of(&train.iter().map(|&i| tails[i]).collect::<Vec<_>>());
    cross_validated(blocks, fit, |fit, i| fit.as_ref().map_or(0.0, |fit| fit.gain(tails[i])))
}

/// Share of tails right after one, of those that the measured side has beyond the simulated one. Edges and small things
/// of the world are in the tails of both sides, several shots in a row.
fn clustering(tails: &[&FrameTails]) -> f64 {
    let sum = |side: usize, of: fn(&Tail) -> f64| tails.iter().copied().flatten().map(|t| of(&t[side])).sum::<f64>();
    let scale = sum(0, |t| t.all) / sum(1, |t| t.all).max(1.0);
    let excess = |of: fn(&Tail) -> f64| sum(0, of) - scale * sum(1, of);
    excess(|t| t.next[1]) / excess(|t| t.next[0]).max(1.0)
}

/// Takes the squares of returns in the tail, and of those that are spread evenly about surfaces, out of the measured
/// sums: what other noise is searched in. The surfaces through a return that is far off are no smooth ones and have no
/// roughness, but for the smallest of what is off.
fn take_out(rough: &mut [RoughFrame], scales: &[f64], mixture: Mixture, leverage: f64) {
    let Mixture { law, share, std_m, stray_per_m } = mixture;
    // Roughness is in units of the noise of one range.
    let off_m = std_m / (1.0 + leverage).sqrt();
    let capped_m2 = |usual_m: &f64| if share > 0.0 { law.capped_m2(CAP * usual_m, *usual_m, off_m) } else { 0.0 };
    let capped_m2: Vec<f64> = scales.iter().map(capped_m2).collect();
    for (c, cell) in rough.iter_mut().flatten() {
        let (usual_m, n) = (scales[*c as usize], cell.measured.n);
        let (range_m, cos) = cell.measured.mean();
        let most_m = most_m(range_m, cos);
        let cap_m = (CAP * usual_m).min(most_m);
        let of_tails = n * share * capped_m2[*c as usize];
        let of_strays = n * stray_per_m * cap_m * cap_m * (most_m - 2.0 / 3.0 * cap_m);
        let others = (cell.measured_squares - of_tails - of_strays) / (1.0 - share - stray_per_m * most_m).max(0.1);
        cell.measured_squares = others.max((n * (0.5 * usual_m).powi(2)).min(cell.measured_squares));
    }
}

/// Bootstrap repetitions for intervals.
const REPETITIONS: usize = 40;

/// Standard errors of share and standard deviation: over blocks of frames, and of the law.
fn errors_of(fitted: &Fit, tails: &[&FrameTails], blocks: &[usize]) -> [f64; 2] {
    let members = blocks_of(blocks);
    let mut rng = data::stream(0, "diagnose tails", 0, 0);
    let draws: Vec<Vec<usize>> = (0..REPETITIONS).map(|_| draw_blocks(&members, &mut rng)).collect();
    let again = |drawn: &Vec<usize>| Fit::of(&drawn.iter().map(|&i| tails[i]).collect::<Vec<_>>());
    let fits: Vec<[f64; 2]> = draws.par_iter().filter_map(again).map(|fit| fit.numbers).collect();
    let by_chance = |k: usize| deviation(&fits.iter().map(|numbers| numbers[k]).collect::<Vec<_>>());
    [0, 1].map(|k| {
        let of_law = fitted.of_law[k].hypot(OF_FORM * fitted.numbers[k]);
        if fits.is_empty() { of_law } else { of_law.hypot(by_chance(k)) }
    })
}

fn describe(
    [share, std_m]: [f64; 2],
    errors: [f64; 2],
    on_estimate: &[&FrameTails],
    held_out_gains: Vec<f64>,
    z: f64,
) -> Found {
    let number: f64 = on_estimate.iter().copied().flatten().map(|t| t[0].beyond).sum();
    let relative = 1.0 / number.max(1.0).sqrt();
    let [simulated, measured] = shares(on_estimate);
    let point =
        CurvePoint { sensor: 0, x: BEYOND, measured, before: simulated, after: measured, error: measured * relative };
    Found {
        status: Status::Named,
        causes: vec![Cause::HeavyTails],
        parameters: vec![parameter(Quantity::Share, share, errors[0]), parameter(Quantity::StdM, std_m, errors[1])],
        confidence: (z / (z + 1.0)).clamp(0.0, 1.0),
        channel: Channel::Roughness,
        covariate: Covariate::None,
        held_out_gains,
        says: format!(
            "{:.2} % of the ranges, single ones, are off by {:.0} cm more than the others: noise with heavy tails",
            100.0 * share,
            100.0 * std_m
        ),
        separate_by: None,
        curve: Curve {
            x: "standard deviations".into(),
            y: "share of the returns beyond".into(),
            by_sensor: false,
            points: vec![point],
        },
        effects: Vec::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::super::mixture::Law;
    use super::*;
    use crate::channels::cells::{CELLS, Place};
    use crate::channels::roughness::RoughCell;
    use rand::RngExt;
    use rand_distr::{Distribution, StandardNormal};

    #[test]
    fn what_is_far_off_is_taken_out_of_the_squares() {
        let mut rng = data::stream(4, "tails", 0, 0);
        let (share, off_m, usual_m, n) = (0.02, 0.26, 0.01, 200_000);
        // As far as returns of a wall are looked at.
        const EVEN_M: f64 = 0.8 * STRAY_M;
        for strays in [0.0, 0.02] {
            let place = Place { n: f64::from(n), ln_range: f64::from(n) * 30f64.ln(), ..Place::default() };
            let mut cell = RoughCell { measured: place, ..RoughCell::default() };
            for _ in 0..n {
                let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
                let (a, b) = (normal(), normal());
                let off = if rng.random_bool(share) { off_m * b } else { 0.0 };
                let stray = rng.random_bool(strays).then(|| rng.random_range(-EVEN_M..EVEN_M));
                let size = stray.unwrap_or(usual_m * a + off).abs();
                cell.measured_squares += size.min(CAP * usual_m).powi(2);
            }
            let mut scales = vec![0.0; CELLS];
            scales[5] = usual_m;
            let mut frames = vec![vec![(5, cell)]];
            let before = cell.variances()[0];
            let mixture = Mixture { law: Law::Normal, share, std_m: off_m, stray_per_m: strays / EVEN_M };
            take_out(&mut frames, &scales, mixture, 0.0);
            let after = frames[0][0].1.variances()[0];
            assert!(before > 1.2 * usual_m.powi(2), "{before}");
            assert!((after / usual_m.powi(2) - 1.0).abs() < 0.03, "{after}");
        }
    }

    #[test]
    fn noise_of_a_surface_comes_shot_after_shot() {
        let clustering = |next: [f64; 2]| {
            let tail = Tail { all: 1e5, beyond: 1e3, next, ..Tail::default() };
            super::clustering(&[&[[tail, Tail::default()], Default::default(), Default::default()]])
        };
        assert!(clustering([1e3, 12.0]) < INDEPENDENT && clustering([1e3, 500.0]) > INDEPENDENT);
    }
}
