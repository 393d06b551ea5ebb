//! Noise with heavy tails: single returns that are much farther off than the others.

use crate::catalogue::{Cause, Channel, Covariate, Quantity};
use crate::channels::roughness::{CAP, RoughFrame};
use crate::channels::tails::{BEYOND, SIZES, Tail, TailBin, size_m, tails};
use crate::curve::{Curve, CurvePoint};
use crate::diagnosis::{Considered, Minimum, Status};
use crate::effects::rounded;
use crate::inference::choice::{significant, total_and_z};
use crate::inference::gain_of_count;
use crate::inference::linear::cross_validated;
use crate::inference::roles::Role;
use crate::inference::simplex::minimise;
use crate::search::{ChannelResult, Context, Found, Z_STAR, first_demands, parameter};
use rayon::prelude::*;
use sensor::Effect;
use sensor::effects::HeavyTails;
use statistics::{blocks_of, deviation, draw_blocks};

/// Smallest share of the returns in the tail that is reported.
const FLOOR: f64 = 3e-4;

/// Excess of the measured tails that is reported, as a share of those of the simulated side.
const SHARE_OF_BASE: f64 = 0.2;

/// Share of tails right after one from which on shots are not independent: noise that depends on the surface is large
/// on a dark surface, shot after shot. The surface through the neighbours of a far return is drawn to it, so that some
/// of them are far from it as well.
const INDEPENDENT: f64 = 0.3;

/// Distance from the surface up to which a return has a roughness, across the surface, m. Returns that are spread
/// evenly up to there are no tail of a noise.
const STRAY_M: f64 = 0.5;

/// Share and standard deviation of what is added to some ranges.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tails {
    /// Share of the returns.
    pub share: f64,
    /// Standard deviation of the additional error, m.
    pub std_m: f64,
    /// Mean variance of the surfaces through neighbours, in units of that of one range.
    pub leverage: f64,
}

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
    let gains = cross_gains(&on_select, &context.blocks(&select));
    let (total, z) = total_and_z(&gains);
    let [base, share] = shares(&on_select);
    let leverage = leverage(context);
    let off_m = fit(&on_select, leverage).map_or(0.0, |t| t.std_m);
    let outcome = match clustering(&on_select) {
        _ if total <= first_demands().nats || !significant(&gains, Z_STAR) => {
            "no more of them than on the simulated side"
        }
        _ if share - base < FLOOR.max(SHARE_OF_BASE * base) => "too few to speak of",
        _ if off_m > STRAY_M => "spread evenly around surfaces: droplets or false alarms",
        more if more > INDEPENDENT => "the next shot is as far off: noise that depends on the surface",
        _ => "chosen",
    };
    result.considered.push(Considered {
        cause: Cause::HeavyTails.into(),
        channel: Channel::Roughness,
        nats_per_ray: total / context.returns(&select).max(1.0),
        z,
        outcome: outcome.into(),
    });
    result.minimum.push((Cause::HeavyTails, Minimum::new(Quantity::Share, FLOOR.max(SHARE_OF_BASE * base))));
    if outcome != "chosen" {
        return 0.0;
    }
    let on_estimate = tail(&estimate);
    let Some(found) = fit(&on_estimate, leverage) else { return 0.0 };
    let [base, share] = shares(&on_estimate);
    let held: Vec<f64> = tail(&hold_out).iter().map(|t| gain(t, base, share)).collect();
    for (d, gain) in result.distance.iter_mut().zip(&held) {
        *d = [d[0] + gain.max(0.0), d[1] + gain, d[2] + gain];
    }
    take_out(rough, scales, found);
    let errors = errors(&on_estimate, &context.blocks(&estimate), leverage);
    result.found.push(describe(found, errors, &on_estimate, held, z));
    found.leverage * found.share * found.std_m * found.std_m
}

/// Shares of the simulated and of the measured returns in the tail.
fn shares(tails: &[&[Tail; 2]]) -> [f64; 2] {
    let share = |side: usize| {
        let sum = |of: fn(&Tail) -> f64| tails.iter().map(|t| of(&t[side])).sum::<f64>();
        (sum(|t| t.beyond) + 0.5) / sum(|t| t.all).max(1.0)
    };
    [share(1), share(0)]
}

/// Gain of a frame by the measured share over the simulated one, nats.
fn gain(frame: &[Tail; 2], base: f64, share: f64) -> f64 {
    gain_of_count(frame[0].beyond, frame[0].all, share.max(base), base)
}

/// Cross-validated gains of the selecting frames, nats.
fn cross_gains(tails: &[&[Tail; 2]], blocks: &[usize]) -> Vec<f64> {
    let fit = |train: &[usize]| shares(&train.iter().map(|&i| tails[i]).collect::<Vec<_>>());
    cross_validated(blocks, fit, |[base, share], i| gain(tails[i], *base, *share))
}

/// Share of tails right after one, of those that the measured side has beyond the simulated one. Edges and small things
/// of the world are in the tails of both sides, several shots in a row.
fn clustering(tails: &[&[Tail; 2]]) -> f64 {
    let sum = |side: usize, of: fn(&Tail) -> f64| tails.iter().map(|t| of(&t[side])).sum::<f64>();
    let scale = sum(0, |t| t.all) / sum(1, |t| t.all).max(1.0);
    let excess = |of: fn(&Tail) -> f64| sum(0, of) - scale * sum(1, of);
    excess(|t| t.next[1]) / excess(|t| t.next[0]).max(1.0)
}

/// Probability that a normal number is farther from 0 than some standard deviations.
fn beyond(deviations: f64) -> f64 {
    libm::erfc(deviations / std::f64::consts::SQRT_2)
}

/// Contribution to the variance of a standard normal number of what lies beyond some standard deviations.
fn variance_beyond(deviations: f64) -> f64 {
    let density = (-0.5 * deviations * deviations).exp() / (2.0 * std::f64::consts::PI).sqrt();
    beyond(deviations) + 2.0 * deviations * density
}

/// What the returns in the tail consist of.
#[derive(Clone, Copy)]
struct Mixture {
    /// Share of the returns with a larger error, and its standard deviation, m.
    share: f64,
    off_m: f64,
    /// Returns that are spread evenly about surfaces, such as parts of things beside them: share for each metre.
    stray_per_m: f64,
}

/// Returns by their usual roughness: their number, the roughness, and the size up to which a return has one, m.
fn usual(tails: &[&[Tail; 2]]) -> Vec<[f64; 3]> {
    let mut sum = vec![TailBin::default(); tails.first().map_or(0, |t| t[0].bins.len())];
    for (to, of) in tails.iter().flat_map(|t| t[0].bins.iter().enumerate()) {
        let b = &mut sum[to];
        *b = TailBin { all: b.all + of.all, usual_m: b.usual_m + of.usual_m, cos: b.cos + of.cos };
    }
    let filled = sum.into_iter().filter(|b| b.all > 0.0);
    filled.map(|b| [b.all, b.usual_m / b.all, STRAY_M / (b.cos / b.all).max(0.05)]).collect()
}

/// Expected number of returns in the tail by their size.
fn expected(usual: &[[f64; 3]], mixture: &Mixture) -> [f64; SIZES] {
    let mut out = [0.0; SIZES];
    for [all, usual_m, most_m] in usual {
        let deviation = usual_m.hypot(mixture.off_m);
        for (bin, sum) in out.iter_mut().enumerate() {
            let from = size_m(bin).max(BEYOND * usual_m);
            let to = size_m(bin + 1).min(*most_m);
            if from < to {
                let normal = beyond(from / deviation) - beyond(to / deviation);
                *sum += all * (mixture.share * normal + mixture.stray_per_m * (to - from));
            }
        }
    }
    out
}

/// Share and standard deviation by which the sizes in the measured tail are likeliest beside those of the simulated
/// side (Poisson); `None` without an excess.
fn fit(tails: &[&[Tail; 2]], leverage: f64) -> Option<Tails> {
    let sum = |side: usize, of: &dyn Fn(&Tail) -> f64| tails.iter().map(|t| of(&t[side])).sum::<f64>();
    let scale = sum(0, &|t| t.all) / sum(1, &|t| t.all).max(1.0);
    let sizes = |side: usize| std::array::from_fn::<f64, SIZES, _>(|k| sum(side, &|t| t.sizes[k]));
    let [measured, simulated] = [sizes(0), sizes(1).map(|n| scale * n)];
    let excess: f64 = measured.iter().zip(simulated).map(|(a, b)| a - b).sum();
    let all = sum(0, &|t| t.all);
    if excess <= 0.0 {
        return None;
    }
    let usual = usual(tails);
    let mixture = |p: &[f64]| Mixture { share: p[0].exp(), off_m: p[1].exp(), stray_per_m: p[2].exp() };
    let surprise = |p: &[f64]| {
        let expected = expected(&usual, &mixture(p));
        let of_bin = |k: usize| {
            let rate = (expected[k] + simulated[k]).max(1e-6);
            rate - measured[k] * rate.ln()
        };
        (0..SIZES).map(of_bin).sum::<f64>()
    };
    let start = [(2.0 * excess / all).ln(), 0.1f64.ln(), (0.1 * excess / all).ln()];
    let (p, _) = minimise(&start, &[0.5, 0.5, -1.0], surprise);
    let Mixture { share, off_m, .. } = mixture(&p);
    // Roughness is in units of the noise of one range, of which a single error has no part in the surface.
    (share < 0.5).then_some(Tails { share, std_m: off_m * (1.0 + leverage).sqrt(), leverage })
}

/// Mean square of a normal number with this deviation, each square at most that of `most`.
fn capped(deviation: f64, most: f64) -> f64 {
    let cap = most / deviation;
    (1.0 - variance_beyond(cap) + cap * cap * beyond(cap)) * deviation * deviation
}

/// Takes the squares of returns in the tail out of the measured sums: what other noise is searched in. The surfaces
/// through such a return are no smooth ones and have no roughness, but for the smallest of what is off.
fn take_out(rough: &mut [RoughFrame], scales: &[f64], Tails { share, std_m, leverage }: Tails) {
    let off_m = std_m / (1.0 + leverage).sqrt();
    for (c, cell) in rough.iter_mut().flatten() {
        let (usual_m, n) = (scales[*c as usize], cell.measured.n);
        let of_tails = n * share * capped(usual_m.hypot(off_m), CAP * usual_m);
        let others = (cell.measured_squares - of_tails) / (1.0 - share);
        cell.measured_squares = others.max((n * (0.5 * usual_m).powi(2)).min(cell.measured_squares));
    }
}

/// Bootstrap repetitions for intervals.
const REPETITIONS: usize = 40;

/// Standard errors of share and standard deviation, over blocks of frames.
fn errors(tails: &[&[Tail; 2]], blocks: &[usize], leverage: f64) -> [f64; 2] {
    let members = blocks_of(blocks);
    let mut rng = data::stream(0, "diagnose tails", 0, 0);
    let draws: Vec<Vec<usize>> = (0..REPETITIONS).map(|_| draw_blocks(&members, &mut rng)).collect();
    let again = |drawn: &Vec<usize>| fit(&drawn.iter().map(|&i| tails[i]).collect::<Vec<_>>(), leverage);
    let fits: Vec<Tails> = draws.par_iter().filter_map(again).collect();
    let error = |of: fn(&Tails) -> f64| deviation(&fits.iter().map(of).collect::<Vec<_>>());
    if fits.is_empty() { [0.0; 2] } else { [error(|t| t.share), error(|t| t.std_m)] }
}

fn describe(tails: Tails, errors: [f64; 2], on_estimate: &[&[Tail; 2]], held_out_gains: Vec<f64>, z: f64) -> Found {
    let Tails { share, std_m, .. } = tails;
    let number: f64 = on_estimate.iter().map(|t| t[0].beyond).sum();
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
        effects: vec![Effect::HeavyTails(HeavyTails { probability: rounded(share, 6), std_m: rounded(std_m, 4) })],
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::channels::cells::CELLS;
    use crate::channels::roughness::RoughCell;
    use rand::RngExt;
    use rand_distr::{Distribution, StandardNormal};

    #[test]
    fn share_and_deviation_are_found_beside_normal_noise() {
        let mut rng = data::stream(3, "tails", 0, 0);
        let (truth, middle_m, all) = (Tails { share: 0.01, std_m: 0.15, leverage: 0.0 }, 0.02, 400_000);
        let mut side = |tails: Option<Tails>| {
            let mut tail = Tail { all: f64::from(all), ..Tail::default() };
            tail.bins[0] = TailBin { all: tail.all, usual_m: middle_m * tail.all, cos: tail.all };
            for _ in 0..all {
                let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
                let (a, b) = (middle_m * normal(), normal());
                let off = tails.filter(|t| rng.random_bool(t.share)).map_or(0.0, |t| t.std_m * b);
                if (a + off).abs() > BEYOND * middle_m {
                    tail.beyond += 1.0;
                    let bin = (0..SIZES).rfind(|k| size_m(*k) <= (a + off).abs()).unwrap_or(0);
                    tail.sizes[bin] += 1.0;
                }
            }
            tail
        };
        let [with, without] = [side(Some(truth)), side(None)];
        let found = fit(&[&[with.clone(), without.clone()]], 0.0).unwrap();
        assert!((found.share / truth.share - 1.0).abs() < 0.1, "{found:?}");
        assert!((found.std_m / truth.std_m - 1.0).abs() < 0.1, "{found:?}");
        assert_eq!(fit(&[&[without, with]], 0.0), None, "the simulated side has them");
    }

    #[test]
    fn parts_of_a_normal_number() {
        assert!((beyond(1.96) - 0.05).abs() < 1e-4);
        assert!((variance_beyond(0.0) - 1.0).abs() < 1e-12 && variance_beyond(6.0) < 1e-6);
    }

    #[test]
    fn what_tails_add_is_taken_out_of_the_squares() {
        let mut rng = data::stream(4, "tails", 0, 0);
        let (tails, usual_m, n) = (Tails { share: 0.02, std_m: 0.3, leverage: 0.3 }, 0.01, 200_000);
        let mut cell = RoughCell::default();
        for _ in 0..n {
            let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
            let (a, b) = (normal(), normal());
            let mut off = |share: f64, m: f64| if rng.random_bool(share) { m * b } else { 0.0 };
            let off_m = tails.std_m / 1.3f64.sqrt();
            cell.measured.n += 1.0;
            cell.measured_squares += (usual_m * a + off(tails.share, off_m)).abs().min(CAP * usual_m).powi(2);
        }
        let mut scales = vec![0.0; CELLS];
        scales[5] = usual_m;
        let mut frames = vec![vec![(5, cell)]];
        let before = cell.variances()[0];
        take_out(&mut frames, &scales, tails);
        let after = frames[0][0].1.variances()[0];
        assert!(before > 1.2 * usual_m.powi(2), "{before}");
        assert!((after / usual_m.powi(2) - 1.0).abs() < 0.03, "{after}");
    }

    #[test]
    fn noise_of_a_surface_comes_shot_after_shot() {
        let clustering = |next: [f64; 2]| {
            let tail = Tail { all: 1e5, beyond: 1e3, next, ..Tail::default() };
            super::clustering(&[&[tail, Tail::default()]])
        };
        assert!(clustering([1e3, 12.0]) < INDEPENDENT && clustering([1e3, 500.0]) > INDEPENDENT);
    }
}
