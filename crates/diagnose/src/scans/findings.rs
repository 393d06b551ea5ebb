//! What scans alone tell, as findings.

mod elevation;
mod noise;
mod rows;

use super::{Seen, comb, gain_of, planes::Patch};
use crate::diagnosis::{Considered, Curve, CurvePoint, Finding, Minimum, Parameter, Status};
use rayon::prelude::*;
use std::collections::BTreeMap;

type Told = (Vec<Finding>, BTreeMap<String, Minimum>, Vec<Considered>);

/// All findings, the smallest effects that would have been seen, and what was weighed.
pub(super) fn all(seen: &Seen, notes: &mut Vec<String>) -> Told {
    let step = comb::find(&seen.scans.iter().collect::<Vec<_>>());
    let mut found: Vec<Option<Finding>> = vec![rows::offsets_found(seen, notes), rows::intensity_found(seen)];
    let (noise, considered) = noise::noise_found(seen, step.map_or(0.002, |c| c.step_m), notes);
    found.extend(noise.into_iter().map(Some));
    found.push(step.map(|s| comb_found(seen, s)));
    found.push(elevation::elevation_found(seen, notes));
    let least =
        |parameter: &str, value: f64, unit: &str| Minimum { parameter: parameter.into(), value, unit: unit.into() };
    let minimum = BTreeMap::from([
        ("beam_range_offset".into(), least("std_m", rows::LEAST_OFFSET_M, "m")),
        ("beam_intensity".into(), least("std", rows::LEAST_INTENSITY, "1")),
        ("quantisation".into(), least("step_m", 0.001, "m")),
    ]);
    (found.into_iter().flatten().collect(), minimum, considered)
}

fn parameter(estimate: f64, unit: &str, ci95: [f64; 2]) -> Parameter {
    let ci95 = [ci95[0].min(estimate), ci95[1].max(estimate)];
    Parameter { estimate, unit: unit.into(), ci95 }
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

fn comb_found(seen: &Seen, told: comb::Comb) -> Finding {
    let n = seen.scans.len();
    let one = |s: usize| {
        let train: Vec<_> = others(n, s).map(|i| &seen.scans[i]).collect();
        let step = comb::find(&train).map_or(told.step_m, |c| c.step_m);
        let c = comb::coherence(&[&seen.scans[s]], step).min(0.999);
        let m: f64 = seen.scans[s].rings.iter().map(|r| r.len() as f64).sum();
        (step, [-(1.0 - c * c).ln() * m, m])
    };
    let each: Vec<(f64, [f64; 2])> = (0..n).into_par_iter().map(one).collect();
    let steps: Vec<f64> = each.iter().map(|e| e.0).collect();
    // Jackknife: each leaves one scan out.
    let error = spread(steps.iter().copied()) * (n as f64 - 1.0).sqrt();
    let half = (1.96 * error).max(2e-7);
    let step = told.step_m;
    let mut share = [0.0f64; 20];
    let mut all = 0.0;
    for b in 0..seen.beams.len() {
        let ranges = || seen.scans.iter().flat_map(|s| &s.rings[b]).map(|s| s.range_m);
        let [re, im] = ranges().fold([0.0; 2], |[re, im], r| {
            let (s, c) = (std::f64::consts::TAU * r / step).sin_cos();
            [re + c, im + s]
        });
        let phase = im.atan2(re) / std::f64::consts::TAU;
        for r in ranges() {
            share[(((r / step - phase + 0.5).rem_euclid(1.0)) * 20.0) as usize % 20] += 1.0;
            all += 1.0;
        }
    }
    let points = (0..20).map(|i| CurvePoint {
        x: (i as f64 + 0.5) / 20.0 - 0.5,
        measured: share[i] / all,
        before: 0.05,
        after: share[i] / all,
        error: share[i].sqrt() / all,
    });
    Finding {
        status: Status::Named,
        cause: Some("quantisation".into()),
        candidates: None,
        family: "range_error".into(),
        parameters: BTreeMap::from([
            ("step_m".to_owned(), parameter(step, "m", [step - half, step + half])),
            (
                "share_on_comb".to_owned(),
                parameter(told.coherence, "1", [told.coherence - 0.02, told.coherence + 0.02]),
            ),
        ]),
        confidence: 1.0,
        channel: "ranges".into(),
        covariate: "fraction of the step".into(),
        gain: gain_of(&each.iter().map(|e| e.1).collect::<Vec<_>>()),
        says: format!("ranges are rounded to {:.3} mm, each laser with a phase of its own", 1000.0 * step),
        separate_by: None,
        curve: Curve { x: "range / step, fraction".into(), y: "share of the returns".into(), points: points.collect() },
        effects: vec![],
    }
}
