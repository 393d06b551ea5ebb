//! Quantisation of ranges: the comb of multiples of a step on which they fall.

use rustfft::{Fft, FftPlanner, num_complex::Complex};
use std::f64::consts::TAU;
use std::sync::Arc;

/// Width of a bin of ranges, m. Steps from two bins on can be found.
pub const BIN_M: f64 = 5e-4;

/// Number of bins: ranges up to 131 m.
const BINS: usize = 1 << 18;

/// Length that the bins cover, m.
pub const LENGTH_M: f64 = BIN_M * BINS as f64;

/// Number of frequencies of a spectrum.
pub const FREQUENCIES: usize = BINS / 2;

/// Where the last bin begins, m.
pub const LAST_BIN_M: f64 = BIN_M * (BINS - 1) as f64;

/// The number of the frequency of a step.
pub fn frequency_of(step_m: f64) -> usize {
    (LENGTH_M / step_m) as usize
}

/// The step of the frequency of a number, m.
pub fn step_of(frequency: usize) -> f64 {
    LENGTH_M / frequency as f64
}

/// Spectra of ranges.
pub struct Spectra(Arc<dyn Fft<f32>>);

impl Default for Spectra {
    fn default() -> Self {
        Spectra(FftPlanner::new().plan_fft_forward(BINS))
    }
}

impl Spectra {
    /// Sum of exp(-2 pi i R / step) over ranges, by frequency.
    pub fn of(&self, ranges: impl IntoIterator<Item = f64>) -> Vec<Complex<f32>> {
        self.of_counts(counts(ranges))
    }

    /// [`Spectra::of`] from the numbers of ranges in each bin, see [`counts`].
    pub fn of_counts(&self, counts: Vec<f32>) -> Vec<Complex<f32>> {
        let mut values: Vec<Complex<f32>> = counts.into_iter().map(|n| Complex::new(n, 0.0)).collect();
        self.0.process(&mut values);
        values.truncate(FREQUENCIES);
        values
    }
}

/// Number of ranges in each bin. Ranges beyond the last bin count in it.
pub fn counts(ranges: impl IntoIterator<Item = f64>) -> Vec<f32> {
    let mut counts = vec![0.0f32; BINS];
    for r in ranges {
        counts[bin_of(r)] += 1.0;
    }
    counts
}

/// The bin of a range.
pub fn bin_of(range_m: f64) -> usize {
    ((range_m / BIN_M) as usize).min(BINS - 1)
}

/// Sum of exp(2 pi i R / step) over ranges, and their number.
pub fn phasor(ranges: impl IntoIterator<Item = f64>, step_m: f64) -> (Complex<f64>, f64) {
    ranges.into_iter().fold((Complex::new(0.0, 0.0), 0.0), |(sum, n), r| {
        let (s, c) = (TAU * r / step_m).sin_cos();
        (Complex::new(sum.re + c, sum.im + s), n + 1.0)
    })
}

/// A search for the best step that narrows around the best of a grid.
#[derive(Clone, Copy, Debug)]
pub struct Refinement {
    /// Rounds.
    pub rounds: usize,
    /// Steps of the grid to either side.
    pub to_either_side: i32,
    /// Factor by which the grid narrows from round to round.
    pub narrows: f64,
}

impl Refinement {
    /// The step with the largest coherence within a share of a first guess, m.
    pub fn best(&self, guess_m: f64, within: f64, coherence: impl Fn(f64) -> f64) -> f64 {
        let (mut best, mut width) = (guess_m, within);
        for _ in 0..self.rounds {
            let side = self.to_either_side;
            let tries = (-side..=side).map(|i| best * (1.0 + width * f64::from(i) / f64::from(side)));
            let judged = tries.map(|s| (coherence(s), s));
            best = judged.max_by(|a, b| a.0.total_cmp(&b.0)).map_or(best, |b| b.1);
            width /= self.narrows;
        }
        best
    }
}
