//! Lasers by themselves: offsets of range and of intensity.

use super::{others, parameter, patches, spread};
use crate::diagnosis::{Curve, CurvePoint, Finding, Status};
use crate::scans::{Seen, brightness, draws, gain_of, interval, offsets};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Spread of offsets of lasers below which nothing is said, m; of intensities.
pub(super) const LEAST_OFFSET_M: f64 = 0.002;
pub(super) const LEAST_INTENSITY: f64 = 0.004;

/// Offsets with larger standard errors do not count in their spread, m.
const SURE_M: f64 = 0.006;

/// Name of a laser in findings: rows count from the lowest.
fn row_name(seen: &Seen, beam: usize) -> String {
    format!("{}/{}", seen.name, seen.beams.len() - 1 - beam)
}

/// Correlation of what two halves of the scans tell.
fn agreement(a: &[Option<f64>], b: &[Option<f64>]) -> f64 {
    let both: Vec<(f64, f64)> = a.iter().zip(b).filter_map(|(a, b)| Some(((*a)?, (*b)?))).collect();
    let n = both.len().max(1) as f64;
    let mean = both.iter().fold((0.0, 0.0), |s, p| (s.0 + p.0 / n, s.1 + p.1 / n));
    let s = both.iter().fold([0.0; 3], |s, p| {
        let (x, y) = (p.0 - mean.0, p.1 - mean.1);
        [s[0] + x * x, s[1] + y * y, s[2] + x * y]
    });
    s[2] / (s[0] * s[1]).sqrt().max(1e-12)
}

fn halves(n: usize) -> [Vec<usize>; 2] {
    [0, 1].map(|h| (0..n).filter(|i| i % 2 == h).collect())
}

/// What one laser is off by, with its interval: along the rows.
fn row_curve(seen: &Seen, values: &[Option<f64>], cis: &[[f64; 2]], before: f64, y: &str) -> Curve {
    let points = (0..values.len()).rev().filter_map(|b| {
        let v = values[b]?;
        let x = (seen.beams.len() - 1 - b) as f64;
        Some(CurvePoint { x, measured: v, before, after: v, error: (cis[b][1] - cis[b][0]) / 3.92 })
    });
    Curve { x: "row, from the lowest".into(), y: y.into(), points: points.collect() }
}

pub(super) fn offsets_found(seen: &Seen, notes: &mut Vec<String>) -> Option<Finding> {
    let walls: Vec<Vec<offsets::WallSums>> = seen
        .walls
        .par_iter()
        .map(|walls| walls.iter().map(|w| offsets::WallSums::new(w, &seen.beams)).collect())
        .collect();
    let n = walls.len();
    let fit = |scans: &[usize]| offsets::fit(&scans.iter().flat_map(|&s| &walls[s]).collect::<Vec<_>>(), &seen.beams);
    let every: Vec<usize> = (0..n).collect();
    let told = fit(&every);
    let known = told.iter().flatten().count();
    if known < 8 {
        notes.push("too few flat walls: nothing can be said of range offsets of single lasers".into());
        return None;
    }
    let drawn: Vec<offsets::Offsets> = draws(n).par_iter().map(|d| fit(d)).collect();
    let cis: Vec<[f64; 2]> = (0..told.len()).map(|b| interval(drawn.iter().filter_map(|d| d[b]).collect())).collect();
    // What chance adds to the spread is taken out; lasers that few walls show are left out of it.
    let error = |b: usize| (cis[b][1] - cis[b][0]) / 3.92;
    let sure: Vec<usize> = (0..told.len()).filter(|&b| told[b].is_some() && error(b) < SURE_M).collect();
    let noise = sure.iter().map(|&b| error(b).powi(2)).sum::<f64>() / sure.len().max(1) as f64;
    let beyond = |o: &offsets::Offsets, times: f64| {
        (spread(sure.iter().filter_map(|&b| o[b])).powi(2) - times * noise).max(0.0).sqrt()
    };
    let std = beyond(&told, 1.0);
    // A draw adds as much chance again.
    let std_ci = interval(drawn.iter().map(|d| beyond(d, 2.0)).collect());
    let none = vec![None; told.len()];
    let gains: Vec<[f64; 2]> = every
        .par_iter()
        .map(|&s| {
            let offsets = fit(&others(n, s).collect::<Vec<_>>());
            // Each wall with a plane and a scatter of its own.
            walls[s].iter().fold([0.0; 2], |sum, w| {
                let ([before, points], [after, _]) = (w.squares(&none), w.squares(&offsets));
                [sum[0] + 0.5 * points * (before / after.max(1e-9)).ln(), sum[1] + points]
            })
        })
        .collect();
    let gain = gain_of(&gains);
    let [odd, even] = halves(n).map(|h| fit(&h));
    let repeats = agreement(&odd, &even);
    if std < LEAST_OFFSET_M || gain.ci95[0] <= 0.0 {
        notes.push(format!(
            "range offsets of single lasers: {:.1} mm from one to the next, {:.4} nats a return on flat walls of other scans: nothing to speak of",
            1000.0 * std,
            gain.nats_per_ray
        ));
        return None;
    }
    let mut parameters = BTreeMap::from([("std_m".to_owned(), parameter(std, "m", std_ci))]);
    for (b, offset) in told.iter().enumerate() {
        if let Some(v) = offset {
            parameters.insert(row_name(seen, b), parameter(*v, "m", cis[b]));
        }
    }
    notes.push(format!(
        "range offsets are known of {known} of {} lasers, up to an offset of all and one that grows with the tangent of the elevation: each wall has a plane of its own",
        told.len()
    ));
    Some(Finding {
        status: Status::Named,
        cause: Some("beam_range_offset".into()),
        candidates: None,
        family: "range_error".into(),
        parameters,
        confidence: repeats.clamp(0.0, 1.0),
        channel: "residuals".into(),
        covariate: "row".into(),
        gain,
        says: format!(
            "each laser has a range offset of its own: {:.1} cm from one to the next; two halves of the scans tell the same (correlation {repeats:.2})",
            100.0 * std
        ),
        separate_by: None,
        curve: row_curve(seen, &told, &cis, 0.0, "offset of range on flat walls, m"),
        effects: vec![],
    })
}

pub(super) fn intensity_found(seen: &Seen) -> Option<Finding> {
    let n = seen.scans.len();
    let sums: Vec<brightness::ContrastSums> = (0..n)
        .into_par_iter()
        .map(|s| {
            let mut sums = vec![[0.0; 3]; seen.beams.len()];
            patches(seen, s).for_each(|p| brightness::add(&mut sums, p));
            sums
        })
        .collect();
    let fit = |scans: &[usize]| brightness::contrasts(&scans.iter().map(|&s| &sums[s]).collect::<Vec<_>>());
    let contrasts = fit(&(0..n).collect::<Vec<_>>());
    if contrasts.iter().flatten().count() < 8 {
        return None;
    }
    let values = |c: &[Option<f64>]| -> Vec<Option<f64>> {
        let near = |b: usize| c[b.saturating_sub(1)..(b + 2).min(c.len())].iter().any(Option::is_some);
        brightness::offsets(c).into_iter().enumerate().map(|(b, v)| near(b).then_some(v)).collect()
    };
    let told = values(&contrasts);
    let drawn: Vec<Vec<Option<f64>>> = draws(n).par_iter().map(|d| values(&fit(d))).collect();
    let cis: Vec<[f64; 2]> = (0..told.len()).map(|b| interval(drawn.iter().filter_map(|d| d[b]).collect())).collect();
    let gains: Vec<[f64; 2]> = (0..n)
        .map(|s| {
            let train: Vec<usize> = others(n, s).collect();
            let told = fit(&train);
            let none: Vec<Option<f64>> = told.iter().map(|t| t.map(|_| 0.0)).collect();
            let variance = |t: &[Option<f64>]| {
                let sum = train
                    .iter()
                    .map(|&i| brightness::squares(&sums[i], t))
                    .fold([0.0; 2], |a, b| [a[0] + b[0], a[1] + b[1]]);
                (sum[0] / sum[1].max(1.0)).max(1e-9)
            };
            let (v0, v1) = (variance(&none), variance(&told));
            let ([s0, m], [s1, _]) = (brightness::squares(&sums[s], &none), brightness::squares(&sums[s], &told));
            [0.5 * (s0 / v0 - s1 / v1) + 0.5 * m * (v0 / v1).ln(), m]
        })
        .collect();
    let gain = gain_of(&gains);
    let std = spread(told.iter().flatten().copied());
    let [odd, even] = halves(n).map(|h| values(&fit(&h)));
    let repeats = agreement(&odd, &even);
    if std < LEAST_INTENSITY || gain.ci95[0] <= 0.0 {
        return None;
    }
    let std_ci = interval(drawn.iter().map(|d| spread(d.iter().flatten().copied())).collect());
    let mut parameters = BTreeMap::from([("std".to_owned(), parameter(std, "1", std_ci))]);
    for (b, v) in told.iter().enumerate() {
        if let Some(v) = v {
            parameters.insert(row_name(seen, b), parameter(*v, "1", cis[b]));
        }
    }
    Some(Finding {
        status: Status::Named,
        cause: Some("beam_intensity".into()),
        candidates: None,
        family: "returns".into(),
        parameters,
        confidence: repeats.clamp(0.0, 1.0),
        channel: "intensity".into(),
        covariate: "row".into(),
        gain,
        says: format!(
            "lasers are not equally bright: on the same surfaces their intensities differ by {std:.3} (of 1) from one to the next; two halves of the scans tell the same (correlation {repeats:.2})"
        ),
        separate_by: None,
        curve: row_curve(seen, &told, &cis, 0.0, "intensity beyond the trend of the rows"),
        effects: vec![],
    })
}
