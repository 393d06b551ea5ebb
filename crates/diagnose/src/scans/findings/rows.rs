//! Offsets of range and of intensity of single lasers.

use super::{Named, around, others, parameter, patches, spread};
use crate::catalogue::sizes::{LASERS_INTENSITY, LASERS_RANGE_M};
use crate::catalogue::{Cause, Channel, Covariate, ParameterId, Quantity, Unit};
use crate::curve::{Curve, CurvePoint};
use crate::diagnosis::{Finding, FindingGain, Parameter};
use crate::scans::{Seen, brightness, draws, gain_of, interval, offsets};
use crate::search::NamedParameter;
use rayon::prelude::*;

/// Offsets with larger standard errors are left out of the spread, m.
const CERTAIN_M: f64 = 0.006;

/// Fewest lasers whose offset is known.
const FEWEST_LASERS: usize = 8;

/// Offset of each laser; `None` where it is not known.
type Offsets = Vec<Option<f64>>;

/// Offsets of all lasers, with what scans say of their uncertainty.
struct Fitted {
    offsets: Offsets,
    /// Offsets fitted on draws of scans.
    drawn: Vec<Offsets>,
    /// 95 % intervals of the offsets.
    cis: Vec<[f64; 2]>,
    /// Correlation of the offsets of two halves of the scans.
    repeats: f64,
}

impl Fitted {
    /// Fits offsets of `n` scans.
    fn new(n: usize, fit: impl Fn(&[usize]) -> Offsets + Sync) -> Self {
        let offsets = fit(&(0..n).collect::<Vec<_>>());
        let drawn: Vec<Offsets> = draws(n).par_iter().map(|d| fit(d)).collect();
        let ci = |b: usize| interval(drawn.iter().filter_map(|d| d[b]).collect());
        let cis = (0..offsets.len()).map(ci).collect();
        let [odd, even] = [0, 1].map(|h| fit(&(0..n).filter(|i| i % 2 == h).collect::<Vec<_>>()));
        Fitted { offsets, drawn, cis, repeats: agreement(&odd, &even) }
    }

    /// Standard error of the offset of a laser.
    fn error(&self, beam: usize) -> f64 {
        (self.cis[beam][1] - self.cis[beam][0]) / 3.92
    }

    /// Offsets of the lasers as parameters; rows count from the lowest.
    fn parameters(&self, seen: &Seen, unit: Unit) -> Vec<NamedParameter> {
        let of_laser = |(b, offset): (usize, &Option<f64>)| {
            let estimate = (*offset)?;
            let id = ParameterId::Row { sensor: seen.name.clone(), row: seen.beams.len() - 1 - b };
            Some((id, Parameter { estimate, unit, ci95: around(estimate, self.cis[b]) }))
        };
        self.offsets.iter().enumerate().filter_map(of_laser).collect()
    }

    /// Offsets along the rows.
    fn curve(&self, seen: &Seen, y: &str) -> Curve {
        let points = (0..self.offsets.len()).rev().filter_map(|b| {
            let v = self.offsets[b]?;
            let x = (seen.beams.len() - 1 - b) as f64;
            Some(CurvePoint { sensor: 0, x, measured: v, before: 0.0, after: v, error: self.error(b) })
        });
        Curve { x: "row, from the lowest".into(), y: y.into(), by_sensor: false, points: points.collect() }
    }
}

/// Correlation of offsets that both of two fits know.
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

/// The finding of range offsets of single lasers.
pub(super) fn offsets_found(seen: &Seen, notes: &mut Vec<String>) -> Option<Finding> {
    let walls: Vec<Vec<offsets::WallSums>> = seen
        .walls
        .par_iter()
        .map(|walls| walls.iter().map(|w| offsets::WallSums::new(w, &seen.beams)).collect())
        .collect();
    let n = walls.len();
    let fit = |scans: &[usize]| offsets::fit(&scans.iter().flat_map(|&s| &walls[s]).collect::<Vec<_>>(), &seen.beams);
    let known = fit(&(0..n).collect::<Vec<_>>()).iter().flatten().count();
    if known < FEWEST_LASERS {
        notes.push("too few flat walls: nothing can be said of range offsets of single lasers".into());
        return None;
    }
    let fitted = Fitted::new(n, fit);
    let (std, std_ci) = spread_beyond_noise(&fitted);
    let gain = offsets_gain(&walls, fit);
    if std < LASERS_RANGE_M || gain.ci95[0] <= 0.0 {
        notes.push(format!(
            "range offsets of single lasers: {:.1} mm from one to the next, {:.4} nats a return on flat walls of other scans: nothing to speak of",
            1000.0 * std,
            gain.nats_per_ray
        ));
        return None;
    }
    notes.push(format!(
        "range offsets are known of {known} of {} lasers, up to an offset of all and one that grows with the tangent of the elevation: each wall has a plane of its own",
        fitted.offsets.len()
    ));
    let mut parameters = vec![parameter(Quantity::StdM, std, std_ci)];
    parameters.extend(fitted.parameters(seen, Unit::Metre));
    let named = Named {
        cause: Cause::BeamRangeOffset,
        parameters,
        confidence: fitted.repeats.clamp(0.0, 1.0),
        channel: Channel::Residuals,
        covariate: Covariate::Row,
        gain,
        says: format!(
            "each laser has a range offset of its own: {:.1} cm from one to the next; two halves of the scans tell the same (correlation {:.2})",
            100.0 * std,
            fitted.repeats
        ),
        curve: fitted.curve(seen, "offset of range on flat walls, m"),
    };
    Some(named.into())
}

/// Standard deviation of the offsets beyond their errors, and its interval. A draw of scans has the variance of the
/// errors twice.
fn spread_beyond_noise(fitted: &Fitted) -> (f64, [f64; 2]) {
    let lasers = 0..fitted.offsets.len();
    let certain: Vec<usize> = lasers.filter(|&b| fitted.offsets[b].is_some() && fitted.error(b) < CERTAIN_M).collect();
    let noise = certain.iter().map(|&b| fitted.error(b).powi(2)).sum::<f64>() / certain.len().max(1) as f64;
    let beyond = |o: &Offsets, times: f64| {
        (spread(certain.iter().filter_map(|&b| o[b])).powi(2) - times * noise).max(0.0).sqrt()
    };
    (beyond(&fitted.offsets, 1.0), interval(fitted.drawn.iter().map(|d| beyond(d, 2.0)).collect()))
}

/// Gain of each scan's walls by offsets fitted on the other scans. Each wall has a plane and a scatter of its own.
fn offsets_gain(walls: &[Vec<offsets::WallSums>], fit: impl Fn(&[usize]) -> Offsets + Sync) -> FindingGain {
    let of_scan = |s: usize| {
        let offsets = fit(&others(walls.len(), s).collect::<Vec<_>>());
        let none = vec![None; offsets.len()];
        walls[s].iter().fold([0.0; 2], |sum, w| {
            let ([before, points], [after, _]) = (w.squares(&none), w.squares(&offsets));
            [sum[0] + 0.5 * points * (before / after.max(1e-9)).ln(), sum[1] + points]
        })
    };
    gain_of(&(0..walls.len()).into_par_iter().map(of_scan).collect::<Vec<[f64; 2]>>())
}

/// The finding of intensities of single lasers.
pub(super) fn intensity_found(seen: &Seen) -> Option<Finding> {
    let n = seen.scans.len();
    let of_scan = |s: usize| {
        let mut sums = vec![[0.0; 3]; seen.beams.len()];
        patches(seen, s).for_each(|p| brightness::add(&mut sums, p));
        sums
    };
    let sums: Vec<brightness::ContrastSums> = (0..n).into_par_iter().map(of_scan).collect();
    let contrasts = |scans: &[usize]| brightness::contrasts(&scans.iter().map(|&s| &sums[s]).collect::<Vec<_>>());
    if contrasts(&(0..n).collect::<Vec<_>>()).iter().flatten().count() < FEWEST_LASERS {
        return None;
    }
    let fitted = Fitted::new(n, |scans| {
        let c = contrasts(scans);
        let near = |b: usize| c[b.saturating_sub(1)..(b + 2).min(c.len())].iter().any(Option::is_some);
        brightness::offsets(&c).into_iter().enumerate().map(|(b, v)| near(b).then_some(v)).collect()
    });
    let gain = intensity_gain(&sums, contrasts);
    let std = spread(fitted.offsets.iter().flatten().copied());
    if std < LASERS_INTENSITY || gain.ci95[0] <= 0.0 {
        return None;
    }
    let std_ci = interval(fitted.drawn.iter().map(|d| spread(d.iter().flatten().copied())).collect());
    let mut parameters = vec![parameter(Quantity::Std, std, std_ci)];
    parameters.extend(fitted.parameters(seen, Unit::One));
    let named = Named {
        cause: Cause::BeamIntensity,
        parameters,
        confidence: fitted.repeats.clamp(0.0, 1.0),
        channel: Channel::Intensity,
        covariate: Covariate::Row,
        gain,
        says: format!(
            "lasers are not equally bright: on the same surfaces their intensities differ by {std:.3} (of 1) from one to the next; two halves of the scans tell the same (correlation {:.2})",
            fitted.repeats
        ),
        curve: fitted.curve(seen, "intensity beyond the trend of the rows"),
    };
    Some(named.into())
}

/// Gain of each scan by contrasts fitted on the other scans.
fn intensity_gain(sums: &[brightness::ContrastSums], contrasts: impl Fn(&[usize]) -> Offsets) -> FindingGain {
    let of_scan = |s: usize| {
        let train: Vec<usize> = others(sums.len(), s).collect();
        let fitted = contrasts(&train);
        let none: Offsets = fitted.iter().map(|t| t.map(|_| 0.0)).collect();
        let variance = |t: &[Option<f64>]| {
            let of_scans = train.iter().map(|&i| brightness::squares(&sums[i], t));
            let sum = of_scans.fold([0.0; 2], |a, b| [a[0] + b[0], a[1] + b[1]]);
            (sum[0] / sum[1].max(1.0)).max(1e-9)
        };
        let (v0, v1) = (variance(&none), variance(&fitted));
        let ([s0, m], [s1, _]) = (brightness::squares(&sums[s], &none), brightness::squares(&sums[s], &fitted));
        [0.5 * (s0 / v0 - s1 / v1) + 0.5 * m * (v0 / v1).ln(), m]
    };
    gain_of(&(0..sums.len()).map(of_scan).collect::<Vec<[f64; 2]>>())
}
