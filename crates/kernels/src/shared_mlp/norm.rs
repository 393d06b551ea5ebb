//! Batch norm and ReLU of blocks of rows, `[rows, channels]`, in the cache.

use crate::batch_norm::{Statistics, non_negative};
use crate::simd::vectorized;

/// Columns that are summed together.
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

    /// Adds to the sums `terms(a, b, weight of the row, column)` of each element of `a` and of `b`, both `[rows,
    /// columns]`.
    #[inline(always)]
    fn add(&mut self, a: &[f32], b: &[f32], weights: &[f32], terms: impl Fn(f32, f32, f64, usize) -> [f64; 2]) {
        let columns = self.first.len();
        for start in (0..columns).step_by(COLUMNS) {
            let width = COLUMNS.min(columns - start);
            let [mut first, mut second] = [[0.0; COLUMNS]; 2];
            let rows = a.chunks_exact(columns).zip(b.chunks_exact(columns)).zip(weights);
            if width == COLUMNS {
                for ((a, b), &weight) in rows {
                    let (a, b) = (&a[start..start + COLUMNS], &b[start..start + COLUMNS]);
                    for j in 0..COLUMNS {
                        let [x, y] = terms(a[j], b[j], weight as f64, start + j);
                        first[j] += x;
                        second[j] += y;
                    }
                }
            } else {
                for ((a, b), &weight) in rows {
                    for j in 0..width {
                        let [x, y] = terms(a[start + j], b[start + j], weight as f64, start + j);
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

    /// Adds values and squares, weighted by the multiplicity of each row.
    pub fn add_moments(&mut self, y: &[f32], counts: &[f32]) {
        vectorized(|| self.add(y, y, counts, |y, _, n, _| [n * y as f64, n * (y as f64 * y as f64)]));
    }

    /// Adds gradients and gradients times deviations from the mean.
    pub fn add_gradients(&mut self, gradient: &[f32], y: &[f32], norm: &Norm) {
        let mean = &norm.mean[..self.first.len()];
        let ones = [1.0; 64];
        let rows = ones.len() * self.first.len();
        for (gradient, y) in gradient.chunks(rows).zip(y.chunks(rows)) {
            vectorized(|| self.add(gradient, y, &ones, |g, y, _, c| [g as f64, g as f64 * (y - mean[c]) as f64]));
        }
    }

    /// The sum of the parts, added in order.
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

    /// Mean and variance from the sums of [`ColumnSums::add_moments`]; `total`: sum of the multiplicities.
    pub fn statistics(&self, total: f64) -> Statistics {
        let moments =
            |(sum, squares): (&f64, &f64)| (sum / total, non_negative(squares / total - (sum / total).powi(2)));
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

    pub fn channels(&self) -> usize {
        self.mean.len()
    }

    #[inline(always)]
    pub fn of(&self, y: f32, channel: usize) -> f32 {
        (y - self.mean[channel]) * self.scale[channel] + self.beta[channel]
    }

    /// `relu(z)` of the rows `y` into `out`.
    pub fn relu(&self, y: &[f32], out: &mut [f32]) {
        let channels = self.channels();
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

/// The gradient of a batch norm for a row of multiplicity n: `dy = g scale + n ((y - mean) slope + offset)`, g the
/// gradient with respect to z.
#[derive(Clone, Debug)]
pub(super) struct NormGradient {
    pub slope: Vec<f64>,
    pub offset: Vec<f64>,
    /// Gradient with respect to gamma.
    pub gamma: Vec<f32>,
    /// Gradient with respect to beta.
    pub beta: Vec<f32>,
}

impl NormGradient {
    /// From the sums of [`ColumnSums::add_gradients`] ; `total`: sum of the multiplicities.
    pub fn new(sums: &ColumnSums, total: f64, statistics: &Statistics, gamma: &[f32], epsilon: f64) -> Self {
        let mut gradient = NormGradient { slope: vec![], offset: vec![], gamma: vec![], beta: vec![] };
        for (c, (sum, product)) in sums.first.iter().zip(&sums.second).enumerate() {
            let inverse = 1.0 / (statistics.variance[c] + epsilon);
            let scale = gamma[c] as f64 * inverse.sqrt();
            gradient.slope.push(-scale * inverse * product / total);
            gradient.offset.push(-scale * sum / total);
            gradient.gamma.push((product * inverse.sqrt()) as f32);
            gradient.beta.push(*sum as f32);
        }
        gradient
    }

    /// `dy` of rows into `out`.
    pub fn apply(&self, g: &[f32], y: &[f32], counts: &[f32], norm: &Norm, out: &mut [f32]) {
        let channels = norm.channels();
        let slope: Vec<f32> = self.slope.iter().map(|&v| v as f32).collect();
        let offset: Vec<f32> = self.offset.iter().map(|&v| v as f32).collect();
        let (slope, offset) = (&slope[..channels], &offset[..channels]);
        let (mean, scale) = (&norm.mean[..channels], &norm.scale[..channels]);
        vectorized(|| {
            let rows = g.chunks_exact(channels).zip(y.chunks_exact(channels)).zip(counts);
            for (((g, y), n), out) in rows.zip(out.chunks_exact_mut(channels)) {
                for c in 0..channels {
                    out[c] = g[c] * scale[c] + n * ((y[c] - mean[c]) * slope[c] + offset[c]);
                }
            }
        });
    }
}

/// Sets the gradient to zero where `activation` is not above zero.
pub(super) fn mask(gradient: &mut [f32], activation: &[f32]) {
    vectorized(|| {
        for (g, &a) in gradient.iter_mut().zip(activation) {
            *g = if a > 0.0 { *g } else { 0.0 };
        }
    });
}
