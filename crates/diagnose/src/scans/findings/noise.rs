//! Noise of the range, over range and incidence.

use super::{Named, parameter, patches};
use crate::catalogue::{Cause, Channel, Covariate, Hypothesis, NoiseForm, Quantity};
use crate::curve::{Curve, CurvePoint};
use crate::diagnosis::{Considered, Finding};
use crate::scans::scatter::{self, Free, NoiseFit, Pooled, ScatterSums, SortedBins};
use crate::scans::{Seen, draws, gain_of, interval};
use rayon::prelude::*;

/// Fewest bins of range and incidence that a law is fitted to.
const FEWEST_BINS: usize = 4;

/// Forms of a noise law, of growing freedom.
const FORMS: [(NoiseForm, Free); 4] = [
    (NoiseForm::Constant, Free { range: false, incidence: false }),
    (NoiseForm::Incidence, Free { range: false, incidence: true }),
    (NoiseForm::Range, Free { range: true, incidence: false }),
    (NoiseForm::RangeAndIncidence, Free { range: true, incidence: true }),
];

/// Findings of noise, and the forms that were compared. `step_m` is the step of the ranges.
pub(super) fn noise_found(seen: &Seen, step_m: f64, notes: &mut Vec<String>) -> (Vec<Finding>, Vec<Considered>) {
    let n = seen.scans.len();
    let of_scan = |s: usize| {
        let mut sums = ScatterSums::new();
        patches(seen, s).for_each(|p| scatter::add(&mut sums, p, &seen.beams));
        sums
    };
    let scans: Vec<ScatterSums> = (0..n).into_par_iter().map(of_scan).collect();
    let every: Vec<usize> = (0..n).collect();
    let sorted = SortedBins::new(&scans);
    if sorted.pooled(&every).len() < FEWEST_BINS {
        return (vec![], vec![]);
    }
    let forms = Forms::new(&scans, sorted);
    let chosen = forms.choose(notes);
    (forms.findings(chosen, step_m), forms.considered(chosen))
}

/// Scans with the likelihoods of the forms.
struct Forms<'a> {
    scans: &'a [ScatterSums],
    sorted: SortedBins<'a>,
    /// By form and scan: log likelihood of the scan under a fit on the other scans, nats, and samples.
    likelihoods: Vec<Vec<[f64; 2]>>,
}

impl<'a> Forms<'a> {
    fn new(scans: &'a [ScatterSums], sorted: SortedBins<'a>) -> Self {
        let rest = sorted.pooled_but_each();
        let of_form = |(_, free): &(NoiseForm, Free)| {
            let of = |s: usize| scatter::likelihood(&scans[s], &scatter::fit(&rest[s], *free));
            (0..scans.len()).map(of).collect()
        };
        let likelihoods = FORMS.par_iter().map(of_form).collect();
        Forms { scans, sorted, likelihoods }
    }

    fn every(&self) -> Vec<usize> {
        (0..self.scans.len()).collect()
    }

    /// Gain of form `a` over form `b` by scan.
    fn over(&self, a: usize, b: usize) -> Vec<[f64; 2]> {
        let both = self.likelihoods[a].iter().zip(&self.likelihoods[b]);
        both.map(|(a, b)| [a[0] - b[0], a[1]]).collect()
    }

    /// Whether form `k` gains significantly over form `from`.
    fn gains(&self, k: usize, from: usize) -> bool {
        gain_of(&self.over(k, from)).ci95[0] > 0.0
    }

    /// The form that gains significantly over all simpler ones. Incidence is tried before range: the footprint of a
    /// beam causes noise at grazing incidence in any case, and a dependence on range must gain more than that.
    fn choose(&self, notes: &mut Vec<String>) -> usize {
        let mut chosen = 0;
        for (k, from) in [(1, 0), (2, 0), (3, 1), (3, 2)] {
            if (from == chosen || from == 0) && self.gains(k, from) && (chosen == 0 || self.gains(k, chosen)) {
                chosen = k;
            }
        }
        if self.gains(1, 0) && self.gains(2, 0) && !self.gains(1, 2) && !self.gains(2, 1) {
            notes.push(
                "whether noise grows with range or with the angle of incidence these scans do not tell: far surfaces are met at an angle".into(),
            );
        }
        chosen
    }

    /// The forms that were compared.
    fn considered(&self, chosen: usize) -> Vec<Considered> {
        let samples: f64 = self.likelihoods[0].iter().map(|l| l[1]).sum();
        let total = |k: usize| self.likelihoods[k].iter().map(|l| l[0]).sum::<f64>();
        let of_form = |(k, (form, _)): (usize, &(NoiseForm, Free))| {
            let gain = gain_of(&self.over(k, 0));
            let z = gain.nats_per_ray / ((gain.ci95[1] - gain.ci95[0]) / 3.92).max(1e-12);
            let outcome = if k == chosen { "chosen" } else { "gains less, or no more with more numbers" };
            Considered {
                cause: Hypothesis { cause: Cause::RangeNoise, form: Some(*form) },
                channel: Channel::Roughness,
                nats_per_ray: (total(k) - total(0)) / samples.max(1.0),
                z,
                outcome: outcome.into(),
            }
        };
        FORMS.iter().enumerate().map(of_form).collect()
    }

    /// Findings of the chosen form: noise of the range, and noise at grazing incidence where the form has it.
    fn findings(&self, chosen: usize, step_m: f64) -> Vec<Finding> {
        let free = FORMS[chosen].1;
        let table = self.sorted.pooled(&self.every());
        let fitted = scatter::fit(&table, free);
        let drawn: Vec<NoiseFit> =
            draws(self.scans.len()).par_iter().map(|d| scatter::fit(&self.sorted.pooled(d), free)).collect();
        let ci = |f: fn(&NoiseFit) -> f64| interval(drawn.iter().map(f).collect());
        let ideal = NoiseFit { std_m: step_m / 12f64.sqrt(), per_m: 0.0, angle_rad: 0.0 };
        let against_ideal: Vec<[f64; 2]> = (0..self.scans.len())
            .map(|s| {
                let [before, m] = scatter::likelihood(&self.scans[s], &ideal);
                [self.likelihoods[chosen][s][0] - before, m]
            })
            .collect();
        let at = |range_m: f64| 1000.0 * (fitted.std_m + range_m * fitted.per_m);
        let noise = Named {
            cause: Cause::RangeNoise,
            parameters: vec![
                parameter(Quantity::StdM, fitted.std_m, ci(|f| f.std_m)),
                parameter(Quantity::PerM, fitted.per_m, ci(|f| f.per_m)),
            ],
            confidence: 1.0,
            channel: Channel::Roughness,
            covariate: if free.range { Covariate::Range } else { Covariate::None },
            gain: gain_of(&against_ideal),
            says: format!(
                "ranges scatter by {:.1} mm at 10 m and {:.1} mm at 30 m at normal incidence; an ideal sensor's by its rounding alone",
                at(10.0),
                at(30.0)
            ),
            curve: curve(&table, &fitted, &ideal, false),
        };
        let at_an_angle = free.incidence.then(|| Named {
            cause: Cause::IncidenceNoise,
            parameters: vec![parameter(Quantity::AngleRad, fitted.angle_rad, ci(|f| f.angle_rad))],
            confidence: 1.0,
            channel: Channel::Roughness,
            covariate: Covariate::RangeTanIncidence,
            gain: gain_of(&self.over(chosen, if free.range { 2 } else { 0 })),
            says: format!(
                "ranges scatter more on surfaces met at an angle, as if by {:.2} mrad: the footprint of the beam, or a jitter of its direction",
                1000.0 * fitted.angle_rad
            ),
            curve: curve(&table, &fitted, &ideal, true),
        });
        std::iter::once(noise).chain(at_an_angle).map(Finding::from).collect()
    }
}

/// Standard deviation along the ray, by the angle of incidence or by range: measured, of an ideal sensor, and fitted.
/// Range is shown on surfaces near normal incidence, where there are enough.
fn curve(table: &Pooled, fitted: &NoiseFit, ideal: &NoiseFit, by_angle: bool) -> Curve {
    let row = |[r, l, m, sd]: &[f64; 4]| {
        let x = if by_angle { (l / r).atan().to_degrees() } else { *r };
        [x, *m, *sd, fitted.variance(*r, *l).sqrt(), ideal.std_m]
    };
    let mut rows: Vec<[f64; 5]> = table.values().map(row).collect();
    if !by_angle {
        let squarely = table.values().zip(&rows).filter(|([r, l, ..], _)| l < &(1.2 * r));
        let squarely: Vec<[f64; 5]> = squarely.map(|(_, row)| *row).collect();
        if squarely.len() >= FEWEST_BINS {
            rows = squarely;
        }
    }
    rows.sort_by(|a, b| a[0].total_cmp(&b[0]));
    let per = (rows.len() as f64 / 12.0).ceil() as usize;
    let points = rows.chunks(per.max(1)).map(|c| {
        let m: f64 = c.iter().map(|r| r[1]).sum();
        let mean = |k: usize| c.iter().map(|r| r[1] * r[k]).sum::<f64>() / m;
        CurvePoint {
            sensor: 0,
            x: mean(0),
            measured: mean(2),
            before: mean(4),
            after: mean(3),
            error: mean(2) / (2.0 * m).sqrt(),
        }
    });
    let x = if by_angle {
        "angle between ray and normal, degrees"
    } else {
        "range (surfaces met at less than 50 degrees), m"
    };
    Curve { x: x.into(), y: "standard deviation along the ray, m".into(), by_sensor: false, points: points.collect() }
}
