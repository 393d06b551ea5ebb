//! Batch norm and ReLU of blocks of rows, `[rows, channels]`, while they are in the cache.

use crate::batch_norm::{Statistics, non_negative};
use crate::simd::vectorized;

/// Columns that sums are taken of together.
const COLUMNS: usize = 16;

/// Two sums for each column, in f64.
#[derive(Clone, Debug)]
pub(super) struct ColumnSums {
    first: Vec<f64>,
    second: Vec<f64>,
}

impl ColumnSums {
    pub fn new(columns: usize) -> Self {
        ColumnSums { first: vec![0.0; columns], second: vec![0.0; columns] }
    }

    /// Adds to the sums `terms(a, b, column)` of each element of `a` and of `b`, both `[rows, columns]`.
    #[inline(always)]
    fn add(&mut self, a: &[f32], b: &[f32], terms: impl Fn(f32, f32, usize) -> [f64; 2]) {
        let columns = self.first.len();
        for start in (0..columns).step_by(COLUMNS) {
            let width = COLUMNS.min(columns - start);
            let [mut first, mut second] = [[0.0; COLUMNS]; 2];
            let rows = a.chunks_exact(columns).zip(b.chunks_exact(columns));
            if width == COLUMNS {
                for (a, b) in rows {
                    let (a, b) = (&a[start..start + COLUMNS], &b[start..start + COLUMNS]);
                    for j in 0..COLUMNS {
                        let [x, y] = terms(a[j], b[j], start + j);
                        first[j] += x;
                        second[j] += y;
                    }
                }
            } else {
                for (a, b) in rows {
                    for j in 0..width {
                        let [x, y] = terms(a[start + j], b[start + j], start + j);
                        first[j] += x;
                        second[j] += y;
                    }
                }
            }
            for j in 0..width {
                self.first[start + j] += first[j];
                self.second[start + j] += second[j];
            }
        }
    }

    /// Adds values and squares.
    pub fn add_moments(&mut self, y: &[f32]) {
        vectorized(|| self.add(y, y, |y, _, _| [y as f64, y as f64 * y as f64]));
    }

    /// Adds gradients and gradients times deviations from the mean.
    pub fn add_gradients(&mut self, gradient: &[f32], y: &[f32], norm: &Norm) {
        let mean = &norm.mean[..self.first.len()];
        vectorized(|| self.add(gradient, y, |g, y, c| [g as f64, g as f64 * (y - mean[c]) as f64]));
    }

    /// The sums of parts, added in order.
    pub fn total<'a>(columns: usize, parts: impl Iterator<Item = &'a ColumnSums>) -> Self {
        let mut total = ColumnSums::new(columns);
        for part in parts {
            for (total, part) in total.first.iter_mut().zip(&part.first) {
                *total += part;
            }
            for (total, part) in total.second.iter_mut().zip(&part.second) {
                *total += part;
            }
        }
        total
    }

    /// Mean and variance, if these are the sums of [`ColumnSums::add_moments`] over `rows` rows; zero where there are none.
    pub fn statistics(&self, rows: usize) -> Statistics {
        let n = rows.max(1) as f64;
        let moments = |(sum, squares): (&f64, &f64)| (sum / n, non_negative(squares / n - (sum / n).powi(2)));
        let (mean, variance) = self.first.iter().zip(&self.second).map(moments).unzip();
        Statistics { mean, variance }
    }

    /// The first sum of each column.
    pub fn first(&self) -> &[f64] {
        &self.first
    }
}

/// `z = (y - mean) scale + beta`, one value a channel.
#[derive(Clone, Debug)]
pub(super) struct Norm {
    pub mean: Vec<f32>,
    pub scale: Vec<f32>,
    pub beta: Vec<f32>,
}

impl Norm {
    pub fn new(statistics: &Statistics, gamma: &[f32], beta: &[f32], epsilon: f64) -> Self {
        let scale = |(&gamma, variance): (&f32, &f64)| (gamma as f64 / (variance + epsilon).sqrt()) as f32;
        Norm {
            mean: statistics.mean.iter().map(|&m| m as f32).collect(),
            scale: gamma.iter().zip(&statistics.variance).map(scale).collect(),
            beta: beta.to_vec(),
        }
    }

    #[inline(always)]
    pub fn of(&self, y: f32, channel: usize) -> f32 {
        (y - self.mean[channel]) * self.scale[channel] + self.beta[channel]
    }

    /// `relu(z)` of the rows `y` into `out`.
    pub fn relu(&self, y: &[f32], out: &mut [f32]) {
        let channels = self.mean.len();
        let (mean, scale, beta) = (&self.mean[..channels], &self.scale[..channels], &self.beta[..channels]);
        vectorized(|| {
            for (y, out) in y.chunks_exact(channels).zip(out.chunks_exact_mut(channels)) {
                for c in 0..channels {
                    let z = (y[c] - mean[c]) * scale[c] + beta[c];
                    out[c] = if z < 0.0 { 0.0 } else { z };
                }
            }
        });
    }
}

/// The gradient of a batch norm: `dy = g scale + (y - mean) slope + offset`, g the gradient by z.
#[derive(Clone, Debug)]
pub(super) struct NormGradient {
    pub slope: Vec<f64>,
    pub offset: Vec<f64>,
    /// Gradient by gamma.
    pub gamma: Vec<f32>,
    /// Gradient by beta.
    pub beta: Vec<f32>,
}

impl NormGradient {
    /// From the sums of [`ColumnSums::add_gradients`] over `rows` rows.
    pub fn new(sums: &ColumnSums, rows: usize, statistics: &Statistics, gamma: &[f32], epsilon: f64) -> Self {
        let n = rows.max(1) as f64;
        let mut gradient = NormGradient { slope: vec![], offset: vec![], gamma: vec![], beta: vec![] };
        for (c, (sum, product)) in sums.first.iter().zip(&sums.second).enumerate() {
            let inverse = 1.0 / (statistics.variance[c] + epsilon);
            let scale = gamma[c] as f64 * inverse.sqrt();
            gradient.slope.push(-scale * inverse * product / n);
            gradient.offset.push(-scale * sum / n);
            gradient.gamma.push((product * inverse.sqrt()) as f32);
            gradient.beta.push(*sum as f32);
        }
        gradient
    }

    /// `dy` of rows into `out`.
    pub fn apply(&self, g: &[f32], y: &[f32], norm: &Norm, out: &mut [f32]) {
        let channels = norm.mean.len();
        let slope: Vec<f32> = self.slope.iter().map(|&v| v as f32).collect();
        let offset: Vec<f32> = self.offset.iter().map(|&v| v as f32).collect();
        let (slope, offset) = (&slope[..channels], &offset[..channels]);
        let (mean, scale) = (&norm.mean[..channels], &norm.scale[..channels]);
        vectorized(|| {
            let rows = g.chunks_exact(channels).zip(y.chunks_exact(channels));
            for ((g, y), out) in rows.zip(out.chunks_exact_mut(channels)) {
                for c in 0..channels {
                    out[c] = g[c] * scale[c] + ((y[c] - mean[c]) * slope[c] + offset[c]);
                }
            }
        });
    }
}

/// Zero where the ReLU was: `activation` is not above zero. NaN in the gradient stays where it passes.
pub(super) fn mask(gradient: &mut [f32], activation: &[f32]) {
    vectorized(|| {
        for (g, &a) in gradient.iter_mut().zip(activation) {
            *g = if a > 0.0 { *g } else { 0.0 };
        }
    });
}
