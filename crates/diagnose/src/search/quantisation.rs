//! Rounded ranges: do measured ranges fall on a comb that simulated ranges do not fall on?

use super::{ChannelResult, Context, Found, parameter};
use crate::diagnosis::{Considered, Curve, CurvePoint, Minimum, Status};
use crate::inference::roles::Role;
use rustfft::{FftPlanner, num_complex::Complex};

/// Width of a bin of ranges, m, and their number: ranges up to 131 m, steps from 2 mm.
const BIN_M: f64 = 5e-4;
const BINS: usize = 1 << 18;

/// Returns looked at.
const RETURNS: usize = 60_000;

/// Share of the ranges that fall on the comb, from which on it is one; simulated ranges must stay below half of it.
const COHERENT: f64 = 0.3;

/// Largest step that is looked for, m: longer ones are structures of the scene.
const LARGEST_M: f64 = 0.4;

/// The search; also the step, m.
pub fn search(context: &Context) -> (ChannelResult, Option<f64>) {
    let [select, estimate, hold_out] = [Role::Select, Role::Estimate, Role::HoldOut].map(|r| context.of(r));
    let mut result = ChannelResult { distance: vec![[0.0; 3]; hold_out.len()], ..ChannelResult::default() };
    let minimum = Minimum { parameter: "step_m".into(), value: 2.0 * BIN_M * 2.0, unit: "m".into() };
    result.minimum.push(("quantisation".into(), minimum));
    let ranges = |frames: &[usize], measured: bool| -> Vec<f64> {
        let side = |i: usize| if measured { &context.frames[i].measured } else { &context.frames[i].simulated };
        let all: usize = frames.iter().map(|&i| side(i).len()).sum();
        let step = (all / RETURNS).max(1);
        frames
            .iter()
            .flat_map(|&i| side(i))
            .step_by(step)
            .map(|r| r.own_range_m())
            .filter(|r| *r < BIN_M * BINS as f64)
            .collect()
    };
    let (a, b) = (ranges(&select, true), ranges(&select, false));
    if a.len() < 500 || b.len() < 500 {
        return (result, None);
    }
    let spectrum = [&a, &b].map(|r| spectrum(r));
    let from = (BIN_M * BINS as f64 / LARGEST_M) as usize;
    let first = (from..BINS / 2).find(|&k| spectrum[0][k] > COHERENT && spectrum[1][k] < 0.5 * COHERENT);
    // The flank of a peak comes before its top; near scenes make wide ones.
    let peak = first.map(|k| top(&spectrum[0], k));
    let strongest = (from..BINS / 2).map(|k| spectrum[0][k]).fold(0.0, f64::max);
    result.considered.push(Considered {
        cause: "quantisation".into(),
        channel: "ranges".into(),
        nats_per_ray: 0.0,
        z: strongest * (a.len() as f64).sqrt(),
        outcome: if peak.is_some() { "chosen".into() } else { "ranges fall on no comb".into() },
    });
    let Some(k) = peak else { return (result, None) };
    // The peak within its bin, then the step from other frames around it.
    let near = refine(&a, BIN_M * BINS as f64 / k as f64, 1.5 / k as f64);
    let on_estimate = ranges(&estimate, true);
    let step = refine(&on_estimate, near, 3e-4);
    let on_comb = coherence(&on_estimate, step);
    let longest = on_estimate.iter().copied().fold(1.0, f64::max);
    let error = step * step / (std::f64::consts::TAU * longest * (on_estimate.len() as f64).sqrt()) * 10.0;
    // A return on the comb tells its place among the steps: ln(step / resolution) nats, by the share that is on it.
    let held: Vec<f64> = hold_out
        .iter()
        .map(|&i| {
            let own = ranges(&[i], true);
            let c = coherence(&own, step).clamp(0.0, 0.999);
            0.5 * -(1.0 - c * c).ln() * context.frames[i].simulated.len() as f64
        })
        .collect();
    for (d, g) in result.distance.iter_mut().zip(&held) {
        *d = [*g; 3];
    }
    let mut fractions = [0.0f64; 20];
    let mut simulated = [0.0f64; 20];
    for (list, counts) in [(&on_estimate, &mut fractions), (&b, &mut simulated)] {
        for r in list {
            counts[((r / step).fract() * 20.0) as usize % 20] += 1.0 / list.len() as f64;
        }
    }
    let points = (0..20).map(|i| CurvePoint {
        x: (i as f64 + 0.5) / 20.0,
        measured: fractions[i],
        before: simulated[i],
        after: fractions[i],
        error: (fractions[i] / on_estimate.len() as f64).sqrt(),
    });
    result.found.push(Found {
        status: Status::Named,
        causes: vec!["quantisation".into()],
        family: "range_error",
        parameters: vec![
            parameter("step_m", step, error.max(1e-6), "m"),
            parameter("share_on_comb", on_comb, 0.02, "1"),
        ],
        confidence: 1.0,
        channel: "ranges",
        covariate: "fraction of the step".into(),
        held_out_gains: held,
        says: format!("measured ranges are rounded to {:.1} mm; simulated ones are not", 1000.0 * step),
        separate_by: None,
        curve: Curve { x: "range / step, fraction".into(), y: "share of the returns".into(), points: points.collect() },
    });
    (result, Some(step))
}

/// The top of the peak on whose flank, or on a smaller one before it, a bin lies: scenes that end sharply make several. Multiples of the comb's
/// frequency lie beyond.
fn top(spectrum: &[f64], flank: usize) -> usize {
    let end = (flank + flank / 2).min(spectrum.len() - 1);
    (flank..=end).max_by(|a, b| spectrum[*a].total_cmp(&spectrum[*b])).unwrap_or(flank)
}

/// |sum of exp(2 pi i R k)| / n for frequencies up to one in two bins.
fn spectrum(ranges: &[f64]) -> Vec<f64> {
    let mut values = vec![Complex::new(0.0f32, 0.0); BINS];
    for r in ranges {
        values[((r / BIN_M) as usize).min(BINS - 1)].re += 1.0;
    }
    FftPlanner::new().plan_fft_forward(BINS).process(&mut values);
    values[..BINS / 2].iter().map(|v| f64::from(v.norm()) / ranges.len() as f64).collect()
}

/// Share of the ranges that fall on a comb of this step.
fn coherence(ranges: &[f64], step: f64) -> f64 {
    let (mut re, mut im) = (0.0, 0.0);
    for r in ranges {
        let (s, c) = (std::f64::consts::TAU * r / step).sin_cos();
        (re, im) = (re + c, im + s);
    }
    re.hypot(im) / ranges.len().max(1) as f64
}

/// The step with the largest coherence within a share of a first guess.
fn refine(ranges: &[f64], guess: f64, within: f64) -> f64 {
    let some: Vec<f64> = ranges.iter().step_by((ranges.len() / 6000).max(1)).copied().collect();
    let (mut best, mut width) = (guess, within);
    for _ in 0..5 {
        let tries = (-20..=20).map(|i| best * (1.0 + width * f64::from(i) / 20.0));
        best = tries.map(|s| (coherence(&some, s), s)).max_by(|a, b| a.0.total_cmp(&b.0)).map_or(best, |b| b.1);
        width /= 8.0;
    }
    best
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
        let k = (0.0437f64.recip() * BIN_M * BINS as f64).round() as usize;
        assert!(spectrum(&rounded)[k] > 0.5 && spectrum(&smooth)[k] < 0.1);
        assert!((refine(&rounded, BIN_M * BINS as f64 / k as f64, 1e-3) - 0.0437).abs() < 1e-5);
    }

    #[test]
    fn a_smaller_peak_before_that_of_the_comb_is_not_taken_for_it() {
        let mut values = vec![0.01; 1000];
        (values[380], values[400], values[800]) = (0.33, 0.95, 0.9);
        assert_eq!(top(&values, 380), 400);
        assert_eq!(top(&values, 400), 400);
    }
}
