//! Quantisation: measured ranges, or coordinates, fall on multiples of a step, simulated ones do not.

use super::{ChannelResult, Context, Found, parameter};
use crate::catalogue::{Cause, Channel, Covariate, Quantity};
use crate::channels::mean::origins;
use crate::curve::{Curve, CurvePoint};
use crate::diagnosis::{Considered, Minimum, Status};
use crate::inference::comb::{self, BIN_M, LENGTH_M, Refinement, Spectra};
use crate::inference::roles::Role;
use crate::pairing::Ray;

/// Returns that are used of each side, at most.
const RETURNS: usize = 60_000;

/// Fewest returns of each side.
const FEWEST: usize = 500;

/// Share of the measured ranges on the comb from which on it is one; the share of the simulated ranges must be below
/// half of it.
const COHERENT: f64 = 0.3;

/// Largest step that is searched for, m: the structure of the scene causes longer periods.
const LARGEST_M: f64 = 0.4;

/// Ranges that a refinement of the step uses, at most.
const REFINED_ON: usize = 6000;

/// How the step is refined.
const REFINEMENT: Refinement = Refinement { rounds: 5, to_either_side: 20, narrows: 8.0 };

/// Half width of the refinement on the estimating frames, as a share of the step.
const WITHIN: f64 = 3e-4;

/// What may be rounded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Rounded {
    /// Ranges, by the sensor.
    Ranges,
    /// The horizontal coordinates in the cloud's frame, by the format of a file. Heights are those of the ground, which
    /// is level in many scenes.
    Coordinates,
}

impl Rounded {
    fn cause(self) -> Cause {
        match self {
            Rounded::Ranges => Cause::Quantisation,
            Rounded::Coordinates => Cause::CoordinateRounding,
        }
    }

    fn name(self) -> &'static str {
        match self {
            Rounded::Ranges => "range",
            Rounded::Coordinates => "coordinate",
        }
    }

    /// The values of some returns, m.
    fn of<'a>(self, context: &Context, rays: impl Iterator<Item = &'a Ray>) -> Vec<f64> {
        let within = |value: &f64| *value < LENGTH_M;
        match self {
            Rounded::Ranges => rays.map(Ray::own_range_m).filter(within).collect(),
            Rounded::Coordinates => {
                let origins = origins(context.rig);
                let point = |r: &Ray| r.point(&origins[usize::from(r.sensor)]);
                rays.map(point).flat_map(|p| [p.x.abs(), p.y.abs()]).filter(within).collect()
            }
        }
    }
}

/// The search, and the step, m.
pub fn search(context: &Context, rounded: Rounded) -> (ChannelResult, Option<f64>) {
    let ranges = |frames: &[usize], measured: bool| values(context, rounded, frames, measured);
    let cause = rounded.cause();
    let [select, estimate, hold_out] = [Role::Select, Role::Estimate, Role::HoldOut].map(|r| context.of(r));
    let mut result = ChannelResult::new(Channel::Ranges, hold_out.len());
    result.minimum.push((cause, Minimum::new(Quantity::StepM, 2.0 * BIN_M * 2.0)));
    let (a, b) = (ranges(&select, true), ranges(&select, false));
    if a.len() < FEWEST || b.len() < FEWEST {
        return (result, None);
    }
    let sides = [a, b];
    let (peak, strongest) = peak_of(&sides);
    let [a, b] = sides;
    result.considered.push(Considered {
        cause: cause.into(),
        channel: Channel::Ranges,
        nats_per_ray: 0.0,
        z: strongest * (a.len() as f64).sqrt(),
        outcome: if peak.is_some() { "chosen".into() } else { format!("{}s fall on no comb", rounded.name()) },
    });
    let Some(k) = peak else { return (result, None) };
    // The peak within its bin on the selecting frames, then the step on the estimating ones.
    let near = refine(&a, comb::step_of(k), 1.5 / k as f64);
    let on_estimate = ranges(&estimate, true);
    let step = refine(&on_estimate, near, WITHIN);
    let held = held_out_gains(context, rounded, &hold_out, step);
    for (d, g) in result.distance.iter_mut().zip(&held) {
        *d = [*g; 3];
    }
    result.found.push(found(rounded, step, &on_estimate, &b, held));
    (result, Some(step))
}

/// Gains of the `test` frames by the combs of the `train` frames, nats; zeros without one.
pub fn by_table(context: &Context, train: &[usize], test: &[usize]) -> Vec<f64> {
    let gains = |rounded: Rounded| {
        let sides = [true, false].map(|measured| values(context, rounded, train, measured));
        let peak = sides.iter().all(|side| side.len() >= FEWEST).then(|| peak_of(&sides).0).flatten()?;
        let step = refine(&sides[0], comb::step_of(peak), 1.5 / peak as f64);
        Some(held_out_gains(context, rounded, test, step))
    };
    let mut sum = vec![0.0; test.len()];
    for of_kind in [Rounded::Ranges, Rounded::Coordinates].into_iter().filter_map(gains) {
        sum.iter_mut().zip(of_kind).for_each(|(s, g)| *s += g);
    }
    sum
}

/// The frequency of the comb on which the first of two sides falls and the second does not; and the strongest one of
/// the first.
fn peak_of(sides: &[Vec<f64>; 2]) -> (Option<usize>, f64) {
    let spectrum = sides.each_ref().map(|r| spectrum(r));
    let from = comb::frequency_of(LARGEST_M);
    let first = (from..comb::FREQUENCIES).find(|&k| spectrum[0][k] > COHERENT && spectrum[1][k] < 0.5 * COHERENT);
    // The flank of a peak comes before its top. Scenes of near surfaces have wide peaks.
    (first.map(|k| top(&spectrum[0], k)), spectrum[0][from..].iter().copied().fold(0.0, f64::max))
}

/// Ranges or coordinates of one side, m, evenly thinned.
fn values(context: &Context, rounded: Rounded, frames: &[usize], measured: bool) -> Vec<f64> {
    let side = |i: usize| if measured { &context.frames[i].measured } else { &context.frames[i].simulated };
    let all: usize = frames.iter().map(|&i| side(i).len()).sum();
    let step = (all / RETURNS).max(1);
    rounded.of(context, frames.iter().flat_map(|&i| side(i)).step_by(step))
}

/// Gains of held-out frames, nats: a range on the comb gives its place between the steps, for the share of ranges on
/// the comb.
fn held_out_gains(context: &Context, rounded: Rounded, hold_out: &[usize], step: f64) -> Vec<f64> {
    let gain = |&i: &usize| {
        let own = values(context, rounded, &[i], true);
        let c = coherence(&own, step).clamp(0.0, 0.999);
        0.5 * -(1.0 - c * c).ln() * context.frames[i].simulated.len() as f64
    };
    hold_out.iter().map(gain).collect()
}

/// The finding, with the distribution of the ranges over the step.
fn found(rounded: Rounded, step: f64, measured: &[f64], simulated: &[f64], held_out_gains: Vec<f64>) -> Found {
    let name = rounded.name();
    let longest = measured.iter().copied().fold(1.0, f64::max);
    let n = measured.len() as f64;
    let error = step * step / (std::f64::consts::TAU * longest * n.sqrt()) * 10.0;
    let [before, after] = [simulated, measured].map(|ranges| {
        let mut counts = [0.0f64; 20];
        for r in ranges {
            counts[((r / step).fract() * 20.0) as usize % 20] += 1.0 / ranges.len() as f64;
        }
        counts
    });
    let points = (0..20).map(|i| CurvePoint {
        sensor: 0,
        x: (i as f64 + 0.5) / 20.0,
        measured: after[i],
        before: before[i],
        after: after[i],
        error: (after[i] / n).sqrt(),
    });
    Found {
        effects: Vec::new(),
        status: Status::Named,
        causes: vec![rounded.cause()],
        parameters: vec![
            parameter(Quantity::StepM, step, error.max(1e-6)),
            parameter(Quantity::ShareOnComb, coherence(measured, step), 0.02),
        ],
        confidence: 1.0,
        channel: Channel::Ranges,
        covariate: Covariate::FractionOfTheStep,
        held_out_gains,
        says: format!("measured {name}s are rounded to {:.1} mm; simulated ones are not", 1000.0 * step),
        separate_by: None,
        curve: Curve {
            x: format!("{name} / step, fraction"),
            y: "share of the returns".into(),
            by_sensor: false,
            points: points.collect(),
        },
    }
}

/// The top of the peak on whose flank a frequency lies, or on the flank of a smaller peak before it: scenes with
/// sharp ends have side peaks. The harmonics of the step lie beyond.
fn top(spectrum: &[f64], flank: usize) -> usize {
    let end = (flank + flank / 2).min(spectrum.len() - 1);
    (flank..=end).max_by(|a, b| spectrum[*a].total_cmp(&spectrum[*b])).unwrap_or(flank)
}

/// Share of the ranges on the comb of each frequency.
fn spectrum(ranges: &[f64]) -> Vec<f64> {
    let sums = Spectra::default().of(ranges.iter().copied());
    sums.iter().map(|v| f64::from(v.norm()) / ranges.len() as f64).collect()
}

/// Share of the ranges on the comb of a step.
fn coherence(ranges: &[f64], step: f64) -> f64 {
    let (sum, _) = comb::phasor(ranges.iter().copied(), step);
    sum.re.hypot(sum.im) / ranges.len().max(1) as f64
}

/// The step with the largest coherence within a share of a first guess, m.
fn refine(ranges: &[f64], guess: f64, within: f64) -> f64 {
    let some: Vec<f64> = ranges.iter().step_by((ranges.len() / REFINED_ON).max(1)).copied().collect();
    REFINEMENT.best(guess, within, |step| coherence(&some, step))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;

    #[test]
    fn a_comb_is_found_with_its_step() {
        let mut rng = data::stream(4, "comb", 0, 0);
        let smooth: Vec<f64> = (0..5000).map(|_| 3.0 + 70.0 * rng.random::<f64>().powi(2)).collect();
        let rounded: Vec<f64> = smooth.iter().map(|r| (r / 0.0437).round() * 0.0437).collect();
        let k = (0.0437f64.recip() * LENGTH_M).round() as usize;
        assert!(spectrum(&rounded)[k] > 0.5 && spectrum(&smooth)[k] < 0.1);
        assert!((refine(&rounded, comb::step_of(k), 1e-3) - 0.0437).abs() < 1e-5);
    }

    #[test]
    fn a_smaller_peak_before_that_of_the_comb_is_not_taken_for_it() {
        let mut values = vec![0.01; 1000];
        (values[380], values[400], values[800]) = (0.33, 0.95, 0.9);
        assert_eq!(top(&values, 380), 400);
        assert_eq!(top(&values, 400), 400);
    }
}
