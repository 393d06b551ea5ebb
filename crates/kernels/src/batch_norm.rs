//! Batch normalisation, optionally followed by a ReLU.

use crate::output::{Shared, fill};
use crate::simd::vectorized;
use rayon::prelude::*;
use std::mem::MaybeUninit;

/// Normalisation of `[batch, channels, pixels]` over batch and pixels, per channel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BatchNorm {
    /// Images, or rows.
    pub batch: usize,
    /// Channels.
    pub channels: usize,
    /// Pixels of an image; 1 for rows `[batch, channels]`.
    pub pixels: usize,
    /// Added to the variance.
    pub epsilon: f64,
    /// Whether a ReLU follows.
    pub relu: bool,
}

/// Mean and variance of each channel, `[channels]`.
#[derive(Clone, Debug, PartialEq)]
pub struct Statistics {
    /// Mean.
    pub mean: Vec<f64>,
    /// Variance with divisor n.
    pub variance: Vec<f64>,
}

/// Rows a task if images are processed as rows of `channels * pixels` values.
const ROWS: usize = 128;

/// Columns of such a row that are processed together.
const COLUMNS: usize = 32;

/// Images with fewer pixels are processed as rows of `channels * pixels` values instead of channel by channel.
const SHORT: usize = 32;

/// Two sums of f32 values in f64, 16 lanes each.
#[derive(Clone, Copy)]
struct Sums([[f64; 16]; 2]);

impl Sums {
    #[inline(always)]
    fn add(&mut self, lane: usize, [first, second]: [f64; 2]) {
        self.0[0][lane] += first;
        self.0[1][lane] += second;
    }

    fn total(&self) -> [f64; 2] {
        self.0.map(|lanes| lanes.iter().sum())
    }
}

impl BatchNorm {
    /// Elements of `x`.
    pub fn len(&self) -> usize {
        self.batch * self.channels * self.pixels
    }

    /// Whether `x` has no elements.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Number of values of a channel.
    fn count(&self) -> f64 {
        (self.batch * self.pixels) as f64
    }

    /// Normalises by the statistics of `x` and returns them; they are zero if `x` is empty. `y` is overwritten.
    ///
    /// # Shapes
    /// `x`, `y`: `[batch, channels, pixels]`; `gamma`, `beta`: `[channels]`.
    pub fn forward_train(&self, x: &[f32], gamma: &[f32], beta: &[f32], y: &mut Vec<f32>) -> Statistics {
        self.check(x, gamma, beta);
        let moments = |x: f32, _: f32, _: &Affine| [x as f64, x as f64 * x as f64];
        let affine = |channel: usize, [sum, squares]: [f64; 2]| {
            let mean = sum / self.count();
            let variance = non_negative(squares / self.count() - mean * mean);
            (Affine::new(gamma[channel], beta[channel], mean, variance, self.epsilon), [mean, variance])
        };
        let apply = |x: f32, _: f32, a: &Affine| self.activated(a.of(x));
        // SAFETY: `two_passes` writes all of y.
        let statistics =
            unsafe { fill(y, self.len(), |y| self.two_passes(x, x, y, |_| Affine::NONE, moments, affine, apply)) };
        let (mean, variance) = statistics.into_iter().map(|[mean, variance]| (mean, variance)).unzip();
        Statistics { mean, variance }
    }

    /// Normalises by given statistics. `y` is overwritten.
    ///
    /// # Shapes
    /// `x`, `y`: `[batch, channels, pixels]`; `gamma`, `beta`: `[channels]`.
    pub fn forward(&self, x: &[f32], gamma: &[f32], beta: &[f32], statistics: &Statistics, y: &mut Vec<f32>) {
        self.check(x, gamma, beta);
        let affine = self.affine(gamma, beta, statistics);
        let normalised = |x: f32, _: f32, a: &Affine| self.activated(a.of(x));
        let row = self.channels * self.pixels;
        let rows = Affines::of_row(if self.pixels < SHORT { row } else { 0 }, |c| affine[c / self.pixels]);
        // SAFETY: every row, or every channel of every image, is written.
        unsafe {
            fill(y, self.len(), |y| {
                if self.is_empty() {
                } else if self.pixels < SHORT {
                    y.par_chunks_mut(ROWS * row).zip(x.par_chunks(ROWS * row)).for_each(|(y, x)| {
                        apply_to_rows(y, (x, x), row, &rows, &normalised);
                    });
                } else {
                    let runs = y.par_chunks_mut(self.pixels).zip(x.par_chunks(self.pixels));
                    runs.with_min_len(1 + 4096 / self.pixels).enumerate().for_each(|(run, (y, x))| {
                        let a = &affine[run % self.channels];
                        vectorized(|| y.iter_mut().zip(x).for_each(|(y, &x)| _ = y.write(normalised(x, x, a))));
                    });
                }
            });
        }
    }

    /// Gradients with respect to `x` (`dx`, overwritten), gamma and beta; `statistics`: those of
    /// [`BatchNorm::forward_train`].
    ///
    /// # Shapes
    /// `x`, `dy`, `dx`: `[batch, channels, pixels]`; all others: `[channels]`.
    pub fn backward(
        &self,
        (x, dy): (&[f32], &[f32]),
        (gamma, beta): (&[f32], &[f32]),
        statistics: &Statistics,
        dx: &mut Vec<f32>,
    ) -> (Vec<f32>, Vec<f32>) {
        self.check(x, gamma, beta);
        assert_eq!(dy.len(), self.len(), "elements of dy of {self:?}");
        let before = self.affine(gamma, beta, statistics);
        let linear = !self.relu;
        let gradient = |x: f32, dy: f32, a: &Affine| if linear | (a.of(x) > 0.0) { dy } else { 0.0 };
        // Sums of g and of g (x - mean).
        let moments = |x: f32, dy: f32, a: &Affine| {
            let g = gradient(x, dy, a) as f64;
            [g, g * (x - a.mean) as f64]
        };
        let affine = |channel: usize, [sum, product]: [f64; 2]| {
            let inverse = 1.0 / (statistics.variance[channel] + self.epsilon);
            let scale = gamma[channel] as f64 * inverse.sqrt();
            let slope = (-scale * inverse * product / self.count()) as f32;
            let offset = (-scale * sum / self.count()) as f32;
            (Affine { slope, offset, ..before[channel] }, [product * inverse.sqrt(), sum])
        };
        // scale (g - mean of g - (x - mean) / variance * mean of g (x - mean))
        let apply = |x: f32, dy: f32, a: &Affine| gradient(x, dy, a) * a.scale + ((x - a.mean) * a.slope + a.offset);
        // SAFETY: `two_passes` writes all of dx.
        let sums =
            unsafe { fill(dx, self.len(), |dx| self.two_passes(x, dy, dx, |c| before[c], moments, affine, apply)) };
        sums.into_iter().map(|[dgamma, dbeta]| (dgamma as f32, dbeta as f32)).unzip()
    }

    #[inline(always)]
    fn activated(&self, z: f32) -> f32 {
        if self.relu && z < 0.0 { 0.0 } else { z }
    }

    fn check(&self, x: &[f32], gamma: &[f32], beta: &[f32]) {
        assert_eq!(x.len(), self.len(), "elements of x of {self:?}");
        assert_eq!((gamma.len(), beta.len()), (self.channels, self.channels), "gamma and beta of {self:?}");
    }

    fn affine(&self, gamma: &[f32], beta: &[f32], statistics: &Statistics) -> Vec<Affine> {
        let Statistics { mean, variance } = statistics;
        (0..self.channels).map(|c| Affine::new(gamma[c], beta[c], mean[c], variance[c], self.epsilon)).collect()
    }

    /// For each channel: sums two values over all of its elements, computes coefficients from the sums, and writes a
    /// function of each element. If images have many pixels, the elements of a channel are still in the cache for the
    /// second pass.
    #[allow(clippy::too_many_arguments)] // two inputs, one output and four callbacks
    fn two_passes(
        &self,
        x: &[f32],
        other: &[f32],
        out: &mut [MaybeUninit<f32>],
        before: impl Fn(usize) -> Affine + Sync,
        moments: impl Fn(f32, f32, &Affine) -> [f64; 2] + Sync,
        affine: impl Fn(usize, [f64; 2]) -> (Affine, [f64; 2]) + Sync,
        apply: impl Fn(f32, f32, &Affine) -> f32 + Sync,
    ) -> Vec<[f64; 2]> {
        if out.is_empty() {
            return vec![[0.0; 2]; self.channels];
        }
        if self.pixels < SHORT {
            return self.short_passes(x, other, out, before, moments, affine, apply);
        }
        let out = Shared::new(out);
        let channel = |channel: usize| {
            let run = |n: usize| (n * self.channels + channel) * self.pixels;
            let before = before(channel);
            let mut sums = Sums([[0.0; 16]; 2]);
            for at in (0..self.batch).map(run) {
                let (x, other) = (&x[at..at + self.pixels], &other[at..at + self.pixels]);
                vectorized(|| {
                    let (x, x_rest) = x.as_chunks::<16>();
                    let (other, other_rest) = other.as_chunks::<16>();
                    for (x, other) in x.iter().zip(other) {
                        for lane in 0..16 {
                            sums.add(lane, moments(x[lane], other[lane], &before));
                        }
                    }
                    for (lane, (&x, &other)) in x_rest.iter().zip(other_rest).enumerate() {
                        sums.add(lane, moments(x, other, &before));
                    }
                });
            }
            let (parameters, result) = affine(channel, sums.total());
            for at in (0..self.batch).map(run) {
                // SAFETY: no other task has this channel.
                let out = unsafe { out.part(at, self.pixels) };
                let (x, other) = (&x[at..at + self.pixels], &other[at..at + self.pixels]);
                vectorized(|| {
                    for ((out, &x), &other) in out.iter_mut().zip(x).zip(other) {
                        out.write(apply(x, other, &parameters));
                    }
                });
            }
            result
        };
        (0..self.channels).into_par_iter().map(channel).collect()
    }

    /// [`BatchNorm::two_passes`] for images with few pixels: some rows of `channels * pixels` columns a task.
    /// The sums of the tasks are added in order, so that the result does not depend on the number of threads.
    #[allow(clippy::too_many_arguments)]
    fn short_passes(
        &self,
        x: &[f32],
        other: &[f32],
        out: &mut [MaybeUninit<f32>],
        before: impl Fn(usize) -> Affine + Sync,
        moments: impl Fn(f32, f32, &Affine) -> [f64; 2] + Sync,
        affine: impl Fn(usize, [f64; 2]) -> (Affine, [f64; 2]) + Sync,
        apply: impl Fn(f32, f32, &Affine) -> f32 + Sync,
    ) -> Vec<[f64; 2]> {
        let row = self.channels * self.pixels;
        let parameters = Affines::of_row(row, |column| before(column / self.pixels));
        let sums_of_rows = |(x, other): (&[f32], &[f32])| {
            let mut sums = vec![[[0.0; COLUMNS]; 2]; parameters.len()];
            vectorized(|| {
                for (x, other) in x.chunks_exact(row).zip(other.chunks_exact(row)) {
                    let groups = x.chunks(COLUMNS).zip(other.chunks(COLUMNS));
                    for ((x, other), (sums, parameters)) in groups.zip(sums.iter_mut().zip(&parameters)) {
                        let (x, other, [mut firsts, mut seconds]) = (padded(x), padded(other), *sums);
                        for c in 0..COLUMNS {
                            let [first, second] = moments(x[c], other[c], &parameters.get(c));
                            firsts[c] += first;
                            seconds[c] += second;
                        }
                        *sums = [firsts, seconds];
                    }
                }
            });
            sums
        };
        let rows = x.par_chunks(ROWS * row).zip(other.par_chunks(ROWS * row));
        let mut sums = vec![[0.0; 2]; self.channels];
        for groups in rows.clone().map(sums_of_rows).collect::<Vec<_>>() {
            for column in 0..row {
                for (sum, of_group) in sums[column / self.pixels].iter_mut().zip(&groups[column / COLUMNS]) {
                    *sum += of_group[column % COLUMNS];
                }
            }
        }
        let of_channels: Vec<(Affine, [f64; 2])> =
            sums.into_iter().enumerate().map(|(c, sum)| affine(c, sum)).collect();
        let parameters = Affines::of_row(row, |column| of_channels[column / self.pixels].0);
        out.par_chunks_mut(ROWS * row).zip(rows).for_each(|(out, (x, other))| {
            apply_to_rows(out, (x, other), row, &parameters, &apply);
        });
        of_channels.into_iter().map(|(_, result)| result).collect()
    }
}

/// Writes a function of each element of some rows.
#[inline(always)]
fn apply_to_rows(
    out: &mut [MaybeUninit<f32>],
    (x, other): (&[f32], &[f32]),
    row: usize,
    parameters: &[Affines],
    apply: &impl Fn(f32, f32, &Affine) -> f32,
) {
    vectorized(|| {
        for ((out, x), other) in out.chunks_exact_mut(row).zip(x.chunks_exact(row)).zip(other.chunks_exact(row)) {
            let groups = out.chunks_mut(COLUMNS).zip(x.chunks(COLUMNS)).zip(other.chunks(COLUMNS));
            for (((out, x), other), parameters) in groups.zip(parameters) {
                let (x, other, mut values) = (padded(x), padded(other), [0.0; COLUMNS]);
                for c in 0..COLUMNS {
                    values[c] = apply(x[c], other[c], &parameters.get(c));
                }
                out.write_copy_of_slice(&values[..out.len()]);
            }
        }
    });
}

/// A copy of a group of columns; the last group is padded with zeros.
#[inline(always)]
fn padded(columns: &[f32]) -> [f32; COLUMNS] {
    columns.try_into().unwrap_or_else(|_| {
        let mut all = [0.0; COLUMNS];
        all[..columns.len()].copy_from_slice(columns);
        all
    })
}

/// The affine function of a channel: `(x - mean) scale + beta`, and for the gradient `(x - mean) slope + offset`.
#[derive(Clone, Copy, Debug)]
struct Affine {
    mean: f32,
    scale: f32,
    beta: f32,
    slope: f32,
    offset: f32,
}

impl Affine {
    const NONE: Affine = Affine { mean: 0.0, scale: 1.0, beta: 0.0, slope: 0.0, offset: 0.0 };

    fn new(gamma: f32, beta: f32, mean: f64, variance: f64, epsilon: f64) -> Self {
        let scale = (gamma as f64 / (variance + epsilon).sqrt()) as f32;
        Affine { mean: mean as f32, scale, beta, ..Affine::NONE }
    }

    #[inline(always)]
    fn of(&self, x: f32) -> f32 {
        (x - self.mean) * self.scale + self.beta
    }
}

/// The coefficients of a group of columns, as arrays for vector registers.
#[derive(Clone, Copy)]
struct Affines([[f32; COLUMNS]; 5]);

impl Affines {
    /// For a row of `row` columns; the last group is padded.
    fn of_row(row: usize, of_column: impl Fn(usize) -> Affine) -> Vec<Self> {
        let group = |first: usize| {
            let mut all = Affines([[0.0; COLUMNS]; 5]);
            for c in first..row.min(first + COLUMNS) {
                let Affine { mean, scale, beta, slope, offset } = of_column(c);
                for (all, value) in all.0.iter_mut().zip([mean, scale, beta, slope, offset]) {
                    all[c - first] = value;
                }
            }
            all
        };
        (0..row).step_by(COLUMNS).map(group).collect()
    }

    #[inline(always)]
    fn get(&self, c: usize) -> Affine {
        let [mean, scale, beta, slope, offset] = &self.0;
        Affine { mean: mean[c], scale: scale[c], beta: beta[c], slope: slope[c], offset: offset[c] }
    }
}

/// Rounding may give a variance slightly below zero, which becomes zero; NaN propagates.
pub(crate) fn non_negative(variance: f64) -> f64 {
    if variance < 0.0 { 0.0 } else { variance }
}

#[cfg(test)]
mod tests;
