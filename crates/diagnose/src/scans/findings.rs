//! Findings of scans alone.

mod elevation;
mod noise;
mod rows;

use super::{Seen, comb, gain_of, planes::Patch};
use crate::catalogue::sizes::{LASERS_INTENSITY, LASERS_RANGE_M};
use crate::catalogue::{Cause, Channel, Covariate, Quantity};
use crate::curve::{Curve, CurvePoint};
use crate::diagnosis::{Considered, Finding, FindingGain, Minimum, Parameter, Status};
use crate::inference::comb::phasor;
use crate::search::NamedParameter;
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Findings, detectable effect sizes, and hypotheses that were considered.
type Findings = (Vec<Finding>, BTreeMap<Cause, Minimum>, Vec<Considered>);

/// Range step where no comb is found: that of the file, m.
const FILE_STEP_M: f64 = 0.002;

/// All findings.
pub(super) fn all(seen: &Seen, notes: &mut Vec<String>) -> Findings {
    let combs = comb::Combs::new(&seen.scans);
    let step = combs.of_all();
    let mut found: Vec<Option<Finding>> = vec![rows::offsets_found(seen, notes), rows::intensity_found(seen)];
    let (noise, considered) = noise::noise_found(seen, step.map_or(FILE_STEP_M, |c| c.step_m), notes);
    found.extend(noise.into_iter().map(Some));
    found.push(step.map(|s| comb_found(seen, &combs, s)));
    found.push(elevation::elevation_found(seen, notes));
    let minimum = BTreeMap::from([
        (Cause::BeamRangeOffset, Minimum::new(Quantity::StdM, LASERS_RANGE_M)),
        (Cause::BeamIntensity, Minimum::new(Quantity::Std, LASERS_INTENSITY)),
        (Cause::Quantisation, Minimum::new(Quantity::StepM, 0.001)),
    ]);
    (found.into_iter().flatten().collect(), minimum, considered)
}

/// What differs between named findings of scans.
struct Named {
    cause: Cause,
    parameters: Vec<NamedParameter>,
    confidence: f64,
    channel: Channel,
    covariate: Covariate,
    gain: FindingGain,
    says: String,
    curve: Curve,
}

impl From<Named> for Finding {
    fn from(named: Named) -> Self {
        Finding {
            status: Status::Named,
            cause: Some(named.cause),
            candidates: None,
            family: named.cause.family(),
            parameters: named.parameters.into_iter().collect(),
            confidence: named.confidence,
            channel: named.channel,
            covariate: named.covariate,
            gain: named.gain,
            predicted: None,
            reached: None,
            says: named.says,
            separate_by: None,
            curve: named.curve,
            effects: vec![],
        }
    }
}

/// A parameter whose interval contains its estimate.
fn parameter(quantity: Quantity, estimate: f64, ci95: [f64; 2]) -> NamedParameter {
    (quantity.into(), Parameter { estimate, unit: quantity.unit(), ci95: around(estimate, ci95) })
}

/// An interval that contains an estimate.
fn around(estimate: f64, ci95: [f64; 2]) -> [f64; 2] {
    [ci95[0].min(estimate), ci95[1].max(estimate)]
}

fn spread(values: impl Iterator<Item = f64> + Clone) -> f64 {
    let n = values.clone().count().max(1) as f64;
    let mean = values.clone().sum::<f64>() / n;
    (values.map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt()
}

/// Numbers of all scans but one.
fn others(n: usize, but: usize) -> impl Iterator<Item = usize> {
    (0..n).filter(move |i| *i != but)
}

fn patches(seen: &Seen, scan: usize) -> impl Iterator<Item = &Patch> {
    seen.walls[scan].iter().chain(&seen.ground[scan])
}

/// The finding of a quantisation step.
fn comb_found(seen: &Seen, combs: &comb::Combs, found: comb::Comb) -> Finding {
    let n = seen.scans.len();
    let steps = combs.of_all_but_each();
    let one = |s: usize| {
        let step = steps[s].map_or(found.step_m, |c| c.step_m);
        let c = comb::coherence(&seen.scans[s], step).min(0.999);
        let m: f64 = seen.scans[s].rings.iter().map(|r| r.len() as f64).sum();
        (step, [-(1.0 - c * c).ln() * m, m])
    };
    let each: Vec<(f64, [f64; 2])> = (0..n).into_par_iter().map(one).collect();
    let steps: Vec<f64> = each.iter().map(|e| e.0).collect();
    // Jackknife: each leaves one scan out.
    let error = spread(steps.iter().copied()) * (n as f64 - 1.0).sqrt();
    let half = (1.96 * error).max(2e-7);
    let (step, coherence) = (found.step_m, found.coherence);
    let named = Named {
        cause: Cause::Quantisation,
        parameters: vec![
            parameter(Quantity::StepM, step, [step - half, step + half]),
            parameter(Quantity::ShareOnComb, coherence, [coherence - 0.02, coherence + 0.02]),
        ],
        confidence: 1.0,
        channel: Channel::Ranges,
        covariate: Covariate::FractionOfTheStep,
        gain: gain_of(&each.iter().map(|e| e.1).collect::<Vec<_>>()),
        says: format!("ranges are rounded to {:.3} mm, each laser with a phase of its own", 1000.0 * step),
        curve: comb_curve(seen, step),
    };
    named.into()
}

/// Distribution of the ranges over the step, the phase of each laser subtracted.
fn comb_curve(seen: &Seen, step: f64) -> Curve {
    let mut share = [0.0f64; 20];
    let mut all = 0.0;
    for b in 0..seen.beams.len() {
        let ranges = || seen.scans.iter().flat_map(|s| &s.rings[b]).map(|s| s.range_m);
        let (sum, _) = phasor(ranges(), step);
        let phase = sum.im.atan2(sum.re) / std::f64::consts::TAU;
        for r in ranges() {
            share[(((r / step - phase + 0.5).rem_euclid(1.0)) * 20.0) as usize % 20] += 1.0;
            all += 1.0;
        }
    }
    let points = (0..20).map(|i| CurvePoint {
        sensor: 0,
        x: (i as f64 + 0.5) / 20.0 - 0.5,
        measured: share[i] / all,
        before: 0.05,
        after: share[i] / all,
        error: share[i].sqrt() / all,
    });
    Curve {
        x: "range / step, fraction".into(),
        y: "share of the returns".into(),
        by_sensor: false,
        points: points.collect(),
    }
}
