//! The step of the ranges: those of each laser fall on a comb of its own phase.

use super::rings::RingScan;
use crate::inference::comb::{self, Refinement, Spectra};

/// Largest step that is searched for, m.
const LARGEST_M: f64 = 0.05;

/// Ratio of the power of a comb to the power of random ranges from which on it is one.
const STANDS_OUT: f64 = 12.0;

/// Fewest returns of a laser.
const FEWEST: f64 = 200.0;

/// Harmonics up to this number are searched for a longer step.
const HARMONICS: usize = 8;

/// How the step is refined.
const REFINEMENT: Refinement = Refinement { rounds: 4, to_either_side: 12, narrows: 6.0 };

/// The step, and how much of the ranges falls on it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Comb {
    /// m.
    pub step_m: f64,
    /// Root mean square over lasers of |mean exp(2 pi i R / step)|.
    pub coherence: f64,
}

fn ranges<'a>(scans: &'a [&RingScan], beam: usize) -> impl Iterator<Item = f64> + 'a {
    scans.iter().flat_map(move |s| &s.rings[beam]).map(|s| s.range_m).filter(|r| *r < comb::LAST_BIN_M)
}

/// The strongest comb; `None` where none stands out.
pub fn find(scans: &[&RingScan]) -> Option<Comb> {
    let from = comb::frequency_of(LARGEST_M);
    let (power, used) = power(scans)?;
    let k = (from..power.len()).max_by(|&i, &j| power[i].total_cmp(&power[j]))?;
    if used < 1.0 || power[k] / used < STANDS_OUT {
        return None;
    }
    // Harmonics of a longer step stand out as well. The longest step with at least half of the power is the fundamental.
    let fundamental = (2..=HARMONICS)
        .rev()
        .map(|m| k / m)
        .find(|&low| low > from && (low.saturating_sub(1)..=low + 1).any(|i| power[i] > 0.5 * power[k]))
        .unwrap_or(k);
    let step_m =
        REFINEMENT.best(comb::step_of(fundamental), 1.0 / fundamental as f64, |step_m| coherence(scans, step_m));
    Some(Comb { step_m, coherence: coherence(scans, step_m) })
}

/// Power by frequency, in units of that of random ranges, summed over lasers, and the number of lasers.
fn power(scans: &[&RingScan]) -> Option<(Vec<f64>, f64)> {
    let beams = scans.first()?.rings.len();
    let mut power = vec![0.0f64; comb::FREQUENCIES];
    let mut used = 0.0;
    let spectra = Spectra::new();
    for beam in 0..beams {
        let n = ranges(scans, beam).count() as f64;
        if n < FEWEST {
            continue;
        }
        let sums = spectra.of(ranges(scans, beam));
        power.iter_mut().zip(&sums).for_each(|(p, v)| *p += f64::from(v.norm_sqr()) / n);
        used += 1.0;
    }
    Some((power, used))
}

/// Root mean square over lasers of the share of their ranges that falls on a comb, beyond chance.
pub fn coherence(scans: &[&RingScan], step_m: f64) -> f64 {
    let beams = scans.first().map_or(0, |s| s.rings.len());
    let (mut sum, mut all) = (0.0, 0.0);
    for beam in 0..beams {
        let (phasor, n) = comb::phasor(ranges(scans, beam), step_m);
        if n >= FEWEST {
            sum += (phasor.re * phasor.re + phasor.im * phasor.im) / n - 1.0;
            all += n;
        }
    }
    (sum / all.max(1.0)).max(0.0).sqrt()
}
