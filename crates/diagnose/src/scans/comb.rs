//! The step of the ranges: each laser's ranges fall on a comb of its own phase.

use super::rings::RingScan;
use rustfft::{FftPlanner, num_complex::Complex};

/// Width of a bin of ranges, m, and their number: ranges up to 131 m, steps from 1 mm.
const BIN_M: f64 = 5e-4;
const BINS: usize = 1 << 18;

/// Largest step that is looked for, m.
const LARGEST_M: f64 = 0.05;

/// A power so many times that of chance is a comb.
const STANDS_OUT: f64 = 12.0;

/// The step, and how much of the ranges falls on it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Comb {
    /// m.
    pub step_m: f64,
    /// Root mean square over lasers of |mean exp(2 pi i R / step)|.
    pub coherence: f64,
}

fn ranges<'a>(scans: &'a [&RingScan], beam: usize) -> impl Iterator<Item = f64> + 'a {
    scans.iter().flat_map(move |s| &s.rings[beam]).map(|s| s.range_m).filter(|r| *r < BIN_M * (BINS - 1) as f64)
}

/// The strongest comb; `None` where none stands out.
pub fn find(scans: &[&RingScan]) -> Option<Comb> {
    let beams = scans.first()?.rings.len();
    let from = (BIN_M * BINS as f64 / LARGEST_M) as usize;
    let mut power = vec![0.0f64; BINS / 2];
    let mut used = 0.0;
    let fft = FftPlanner::new().plan_fft_forward(BINS);
    for beam in 0..beams {
        let mut values = vec![Complex::new(0.0f32, 0.0); BINS];
        let mut n = 0.0;
        for r in ranges(scans, beam) {
            values[(r / BIN_M) as usize].re += 1.0;
            n += 1.0;
        }
        if n < 200.0 {
            continue;
        }
        fft.process(&mut values);
        power.iter_mut().zip(&values).for_each(|(p, v)| *p += f64::from(v.norm_sqr()) / n);
        used += 1.0;
    }
    let k = (from..BINS / 2).max_by(|&i, &j| power[i].total_cmp(&power[j]))?;
    if used < 1.0 || power[k] / used < STANDS_OUT {
        return None;
    }
    // Overtones of a longer step stand out as well: the longest step that does nearly as much is the step.
    let fundamental = (2..=8)
        .rev()
        .map(|m| k / m)
        .find(|&low| low > from && (low.saturating_sub(1)..=low + 1).any(|i| power[i] > 0.5 * power[k]));
    let guess = BIN_M * BINS as f64 / fundamental.unwrap_or(k) as f64;
    let (mut best, mut width) = (guess, 1.0 / fundamental.unwrap_or(k) as f64);
    for _ in 0..4 {
        let tries = (-12..=12).map(|i| best * (1.0 + width * f64::from(i) / 12.0));
        best = tries.map(|s| (coherence(scans, s), s)).max_by(|a, b| a.0.total_cmp(&b.0)).map_or(best, |b| b.1);
        width /= 6.0;
    }
    Some(Comb { step_m: best, coherence: coherence(scans, best) })
}

/// Root mean square over lasers of the share of their ranges that falls on a comb, beyond chance.
pub fn coherence(scans: &[&RingScan], step_m: f64) -> f64 {
    let beams = scans.first().map_or(0, |s| s.rings.len());
    let (mut sum, mut all) = (0.0, 0.0);
    for beam in 0..beams {
        let (mut re, mut im, mut n) = (0.0, 0.0, 0.0);
        for r in ranges(scans, beam) {
            let (s, c) = (std::f64::consts::TAU * r / step_m).sin_cos();
            (re, im, n) = (re + c, im + s, n + 1.0);
        }
        if n >= 200.0 {
            sum += (re * re + im * im) / n - 1.0;
            all += n;
        }
    }
    (sum / all.max(1.0)).max(0.0).sqrt()
}
