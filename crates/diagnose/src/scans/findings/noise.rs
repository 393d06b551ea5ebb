//! Noise of the range, over range and incidence.

use super::{others, parameter, patches};
use crate::diagnosis::{Considered, Curve, CurvePoint, Finding, FindingGain, Status};
use crate::scans::{Seen, draws, gain_of, interval, scatter};
use rayon::prelude::*;
use std::collections::BTreeMap;

pub(super) fn noise_found(seen: &Seen, step_m: f64, notes: &mut Vec<String>) -> (Vec<Finding>, Vec<Considered>) {
    use scatter::{Free, NoiseFit};
    let n = seen.scans.len();
    let sums: Vec<scatter::ScatterSums> = (0..n)
        .into_par_iter()
        .map(|s| {
            let mut sums = scatter::ScatterSums::new();
            patches(seen, s).for_each(|p| scatter::add(&mut sums, p, &seen.beams));
            sums
        })
        .collect();
    let bins = |scans: &[usize]| scatter::pooled(&scans.iter().map(|&s| &sums[s]).collect::<Vec<_>>());
    let every: Vec<usize> = (0..n).collect();
    if bins(&every).len() < 4 {
        return (vec![], vec![]);
    }
    // Steps of growing freedom; each must gain on scans that it was not fitted on.
    let none = Free { range: false, incidence: false };
    let steps = [
        none,
        Free { range: false, incidence: true },
        Free { range: true, incidence: false },
        Free { range: true, incidence: true },
    ];
    let likelihoods: Vec<Vec<[f64; 2]>> = steps
        .par_iter()
        .map(|free| {
            let of = |s: usize| {
                scatter::likelihood(&sums[s], &scatter::fit(&bins(&others(n, s).collect::<Vec<_>>()), *free))
            };
            (0..n).map(of).collect()
        })
        .collect();
    let over = |a: usize, b: usize| -> Vec<[f64; 2]> {
        (0..n).map(|s| [likelihoods[a][s][0] - likelihoods[b][s][0], likelihoods[a][s][1]]).collect()
    };
    let total = |k: usize| likelihoods[k].iter().map(|l| l[0]).sum::<f64>();
    let gains = |k: usize, from: usize| gain_of(&over(k, from)).ci95[0] > 0.0;
    let mut chosen = 0;
    for (k, from) in [(1, 0), (2, 0), (3, 1), (3, 2)] {
        // The footprint of a beam makes noise at an angle whatever else there is: range must do better.
        if (from == chosen || from == 0) && gains(k, from) && (chosen == 0 || gains(k, chosen)) {
            chosen = k;
        }
    }
    if gains(1, 0) && gains(2, 0) && !gains(1, 2) && !gains(2, 1) {
        notes.push(
            "whether noise grows with range or with the angle of incidence these scans do not tell: far surfaces are met at an angle".into(),
        );
    }
    let samples: f64 = likelihoods[0].iter().map(|l| l[1]).sum();
    let words = ["the same everywhere", "with incidence", "with range", "with range and incidence"];
    let considered = (0..steps.len())
        .map(|k| {
            let gain = gain_of(&over(k, 0));
            let z = gain.nats_per_ray / ((gain.ci95[1] - gain.ci95[0]) / 3.92).max(1e-12);
            let outcome =
                if k == chosen { "chosen".to_owned() } else { "gains less, or no more with more numbers".into() };
            Considered {
                cause: format!("range_noise, {}", words[k]),
                channel: "roughness".into(),
                nats_per_ray: (total(k) - total(0)) / samples.max(1.0),
                z,
                outcome,
            }
        })
        .collect();
    let fitted = scatter::fit(&bins(&every), steps[chosen]);
    let drawn: Vec<NoiseFit> = draws(n).par_iter().map(|d| scatter::fit(&bins(d), steps[chosen])).collect();
    let ci = |f: fn(&NoiseFit) -> f64| interval(drawn.iter().map(f).collect());
    let ideal = NoiseFit { std_m: step_m / 12f64.sqrt(), per_m: 0.0, angle_rad: 0.0 };
    let against: Vec<[f64; 2]> = (0..n)
        .map(|s| {
            let [before, m] = scatter::likelihood(&sums[s], &ideal);
            [likelihoods[chosen][s][0] - before, m]
        })
        .collect();
    let table = bins(&every);
    let curve = |by_lever: bool| {
        let mut rows: Vec<[f64; 5]> = table
            .values()
            .map(|[r, l, m, sd]| {
                let x = if by_lever { (l / r).atan().to_degrees() } else { *r };
                [x, *m, *sd, fitted.variance(*r, *l).sqrt(), ideal.std_m]
            })
            .collect();
        // Range by what is met squarely, incidence by all.
        if !by_lever {
            let square: Vec<[f64; 5]> =
                table.values().zip(&rows).filter(|([r, l, ..], _)| l < &(1.2 * r)).map(|(_, row)| *row).collect();
            if square.len() >= 4 {
                rows = square;
            }
        }
        rows.sort_by(|a, b| a[0].total_cmp(&b[0]));
        let per = (rows.len() as f64 / 12.0).ceil() as usize;
        let points = rows.chunks(per.max(1)).map(|c| {
            let m: f64 = c.iter().map(|r| r[1]).sum();
            let mean = |k: usize| c.iter().map(|r| r[1] * r[k]).sum::<f64>() / m;
            CurvePoint {
                x: mean(0),
                measured: mean(2),
                before: mean(4),
                after: mean(3),
                error: mean(2) / (2.0 * m).sqrt(),
            }
        });
        let x = if by_lever {
            "angle between ray and normal, degrees"
        } else {
            "range (surfaces met at less than 50 degrees), m"
        };
        Curve { x: x.into(), y: "standard deviation along the ray, m".into(), points: points.collect() }
    };
    let finding = |cause: &str, covariate: &str, parameters, gain: FindingGain, says: String, curve: Curve| Finding {
        status: Status::Named,
        cause: Some(cause.into()),
        candidates: None,
        family: "range_error".into(),
        parameters,
        confidence: 1.0,
        channel: "roughness".into(),
        covariate: covariate.into(),
        gain,
        says,
        separate_by: None,
        curve,
        effects: vec![],
    };
    let mut found = vec![finding(
        "range_noise",
        if steps[chosen].range { "range_m" } else { "none" },
        BTreeMap::from([
            ("std_m".to_owned(), parameter(fitted.std_m, "m", ci(|f| f.std_m))),
            ("per_m".to_owned(), parameter(fitted.per_m, "m/m", ci(|f| f.per_m))),
        ]),
        gain_of(&against),
        format!(
            "ranges scatter by {:.1} mm at 10 m and {:.1} mm at 30 m on surfaces met squarely; an ideal sensor's by its rounding alone",
            1000.0 * (fitted.std_m + 10.0 * fitted.per_m),
            1000.0 * (fitted.std_m + 30.0 * fitted.per_m)
        ),
        curve(false),
    )];
    if steps[chosen].incidence {
        let without = if steps[chosen].range { 2 } else { 0 };
        found.push(finding(
            "incidence_noise",
            "range_m * tan(incidence)",
            BTreeMap::from([("angle_rad".to_owned(), parameter(fitted.angle_rad, "rad", ci(|f| f.angle_rad)))]),
            gain_of(&over(chosen, without)),
            format!(
                "ranges scatter more on surfaces met at an angle, as if by {:.2} mrad: the footprint of the beam, or a jitter of its direction",
                1000.0 * fitted.angle_rad
            ),
            curve(true),
        ));
    }
    (found, considered)
}
