//! The step of the ranges: those of each laser fall on a comb of its own phase.
//!
//! The comb of all scans but one is found for each scan. What it needs are sums over scans: numbers of ranges in bins,
//! and phasors. They are computed once, and the part of the scan that is left out is subtracted, so that the time grows
//! with the number of scans and not with its square.

use super::rings::RingScan;
use crate::inference::comb::{self, Refinement, Spectra};
use rayon::prelude::*;
use rustfft::num_complex::Complex;
use std::collections::HashMap;
use std::sync::Mutex;

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

fn ranges(scan: &RingScan, beam: usize) -> impl Iterator<Item = f64> + '_ {
    scan.rings[beam].iter().map(|s| s.range_m).filter(|r| *r < comb::LAST_BIN_M)
}

/// Searches for the combs of all scans together and of all but one.
pub struct Combs<'a> {
    scans: &'a [RingScan],
    spectra: Spectra,
    /// By laser: ranges of all scans in each bin.
    counts: Vec<Vec<f32>>,
    /// By the bits of a step: coherence of all scans, and then of all but each.
    judged: Mutex<HashMap<u64, Vec<f64>>>,
}

impl<'a> Combs<'a> {
    /// Sums of all scans.
    pub fn new(scans: &'a [RingScan]) -> Combs<'a> {
        let beams = scans.first().map_or(0, |s| s.rings.len());
        let of_beam = |beam: usize| comb::counts(scans.iter().flat_map(|s| ranges(s, beam)));
        let counts = (0..beams).into_par_iter().map(of_beam).collect();
        Combs { scans, spectra: Spectra::default(), counts, judged: Mutex::default() }
    }

    /// The strongest comb of all scans; `None` where none stands out.
    pub fn of_all(&self) -> Option<Comb> {
        Some(self.refined(self.fundamental(None)?, None))
    }

    /// The strongest comb of all scans but one, for each.
    pub fn of_all_but_each(&self) -> Vec<Option<Comb>> {
        let but = |s: usize| self.fundamental(Some(s));
        let found: Vec<Option<usize>> = (0..self.scans.len()).into_par_iter().map(but).collect();
        found.into_iter().enumerate().map(|(s, k)| Some(self.refined(k?, Some(s)))).collect()
    }

    /// The frequency of the strongest comb.
    fn fundamental(&self, but: Option<usize>) -> Option<usize> {
        let from = comb::frequency_of(LARGEST_M);
        let (power, used) = self.power(but);
        let k = (from..power.len()).max_by(|&i, &j| power[i].total_cmp(&power[j]))?;
        if used < 1.0 || power[k] / used < STANDS_OUT {
            return None;
        }
        // Harmonics of a longer step stand out as well. The longest step with at least half of the power is the
        // fundamental.
        let fundamental = (2..=HARMONICS)
            .rev()
            .map(|m| k / m)
            .find(|&low| low > from && (low.saturating_sub(1)..=low + 1).any(|i| power[i] > 0.5 * power[k]));
        Some(fundamental.unwrap_or(k))
    }

    fn refined(&self, fundamental: usize, but: Option<usize>) -> Comb {
        let of = |step_m: f64| self.coherence_at(step_m, but);
        let step_m = REFINEMENT.best(comb::step_of(fundamental), 1.0 / fundamental as f64, of);
        Comb { step_m, coherence: of(step_m) }
    }

    /// Power by frequency, in units of that of random ranges, summed over lasers, and the number of lasers.
    fn power(&self, but: Option<usize>) -> (Vec<f64>, f64) {
        let mut power = vec![0.0f64; comb::FREQUENCIES];
        let mut used = 0.0;
        for (beam, all) in self.counts.iter().enumerate() {
            let mut counts = all.clone();
            if let Some(s) = but {
                ranges(&self.scans[s], beam).for_each(|r| counts[comb::bin_of(r)] -= 1.0);
            }
            let n: f64 = counts.iter().map(|n| f64::from(*n)).sum();
            if n < FEWEST {
                continue;
            }
            let sums = self.spectra.of_counts(counts);
            power.iter_mut().zip(&sums).for_each(|(p, v)| *p += f64::from(v.norm_sqr()) / n);
            used += 1.0;
        }
        (power, used)
    }

    /// Coherence of all scans but one. The searches meet the same steps, so that each is computed once for all.
    fn coherence_at(&self, step_m: f64, but: Option<usize>) -> f64 {
        let mut judged = self.judged.lock().expect("no thread panics while it computes sums");
        let of_step = judged.entry(step_m.to_bits()).or_insert_with(|| self.coherences(step_m));
        of_step[but.map_or(0, |s| s + 1)]
    }

    /// Coherence of all scans, and then of all but each.
    fn coherences(&self, step_m: f64) -> Vec<f64> {
        let each: Vec<Vec<Phasor>> = self.scans.par_iter().map(|s| phasors(s, step_m)).collect();
        let mut all = vec![(Complex::new(0.0, 0.0), 0.0); self.counts.len()];
        for scan in &each {
            all.iter_mut().zip(scan).for_each(|(sum, own)| *sum = (sum.0 + own.0, sum.1 + own.1));
        }
        let but = |own: &Vec<Phasor>| coherent(all.iter().zip(own).map(|(a, o)| (a.0 - o.0, a.1 - o.1)));
        std::iter::once(coherent(all.iter().copied())).chain(each.iter().map(but)).collect()
    }
}

/// Sum of exp(2 pi i R / step) over ranges of a laser, and their number.
type Phasor = (Complex<f64>, f64);

fn phasors(scan: &RingScan, step_m: f64) -> Vec<Phasor> {
    (0..scan.rings.len()).map(|beam| comb::phasor(ranges(scan, beam), step_m)).collect()
}

/// Coherence of one scan.
pub fn coherence(scan: &RingScan, step_m: f64) -> f64 {
    coherent(phasors(scan, step_m).into_iter())
}

/// Root mean square over lasers of the share of their ranges that falls on a comb, beyond chance.
fn coherent(lasers: impl Iterator<Item = Phasor>) -> f64 {
    let (mut sum, mut all) = (0.0, 0.0);
    for (phasor, n) in lasers.filter(|l| l.1 >= FEWEST) {
        sum += (phasor.re * phasor.re + phasor.im * phasor.im) / n - 1.0;
        all += n;
    }
    (sum / f64::max(all, 1.0)).max(0.0).sqrt()
}

#[cfg(test)]
mod tests {
    use super::super::rings::Shot;
    use super::*;
    use rand::RngExt;

    /// Scans of nine lasers whose ranges are rounded to 4 mm, each laser with a phase of its own.
    fn scans() -> Vec<RingScan> {
        let mut rng = data::stream(1, "comb test", 0, 0);
        let mut scan = |s: usize| {
            let mut ring = |beam: usize| -> Vec<Shot> {
                let mut shot = || {
                    let rounded = (rng.random_range(3.0..60.0f64) / 0.004).round() * 0.004;
                    let range_m = rounded + 0.0004 * beam as f64 + rng.random_range(-3e-4..3e-4);
                    Shot { azimuth_rad: 0.0, range_m, intensity: 0.0 }
                };
                (0..250 + 20 * s).map(|_| shot()).collect()
            };
            RingScan { id: s.to_string(), rings: (0..9).map(&mut ring).collect() }
        };
        (0..5).map(&mut scan).collect()
    }

    #[test]
    fn combs_of_all_scans_but_one_are_those_of_the_others() {
        let scans = scans();
        let all = Combs::new(&scans).of_all().unwrap();
        assert!((all.step_m - 0.004).abs() < 1e-6 && all.coherence > 0.9, "{all:?}");
        for (s, got) in Combs::new(&scans).of_all_but_each().into_iter().enumerate() {
            let others: Vec<RingScan> = scans.iter().filter(|scan| scan.id != s.to_string()).cloned().collect();
            let (got, want) = (got.unwrap(), Combs::new(&others).of_all().unwrap());
            assert!(got.step_m == want.step_m && (got.coherence - want.coherence).abs() < 1e-12, "{got:?} {want:?}");
        }
    }
}
