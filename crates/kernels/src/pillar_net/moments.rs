//! Sums over all points of their values and of their outer products.

use super::MOST_INPUTS;
use crate::simd::vectorized;
use rayon::prelude::*;

/// First and second moments of the inputs, in f64.
#[derive(Clone, Debug)]
pub(super) struct Moments {
    /// Sum over the points of x, `[F]`, padded with zeros.
    pub sum: [f64; MOST_INPUTS],
    /// Sum over the points of x x^T, `[F, F]`, padded with zeros.
    pub products: [[f64; MOST_INPUTS]; MOST_INPUTS],
}

impl Moments {
    const ZERO: Moments = Moments { sum: [0.0; MOST_INPUTS], products: [[0.0; MOST_INPUTS]; MOST_INPUTS] };

    /// The moments of `features`, `[N, inputs]`, summed in `parts` parts that are added in order.
    pub fn of(features: &[f32], inputs: usize, parts: usize) -> Self {
        if features.is_empty() {
            return Moments::ZERO;
        }
        let rows = (features.len() / inputs).div_ceil(parts);
        let parts: Vec<Moments> =
            features.par_chunks(rows * inputs).map(|part| vectorized(|| Moments::of_part(part, inputs))).collect();
        let mut total = Moments::ZERO;
        for part in &parts {
            for i in 0..inputs {
                total.sum[i] += part.sum[i];
                for j in 0..inputs {
                    total.products[i][j] += part.products[i][j];
                }
            }
        }
        total
    }

    #[inline(always)]
    fn of_part(features: &[f32], inputs: usize) -> Self {
        let mut moments = Moments::ZERO;
        for row in features.chunks_exact(inputs) {
            let mut x = [0.0; MOST_INPUTS];
            for (x, &value) in x.iter_mut().zip(row) {
                *x = value as f64;
            }
            for j in 0..MOST_INPUTS {
                moments.sum[j] += x[j];
            }
            for (products, xi) in moments.products[..inputs].iter_mut().zip(x) {
                for j in 0..MOST_INPUTS {
                    products[j] += xi * x[j];
                }
            }
        }
        moments
    }

    /// Sum over the points of w x.
    pub fn sum_along(&self, weight: &[f32]) -> f64 {
        weight.iter().zip(&self.sum).map(|(&w, sum)| w as f64 * sum).sum()
    }

    /// Sum over the points of (w x) x, `[F]`.
    pub fn products_along(&self, weight: &[f32]) -> [f64; MOST_INPUTS] {
        std::array::from_fn(|k| weight.iter().zip(&self.products).map(|(&w, row)| w as f64 * row[k]).sum())
    }

    /// Sum over the points of (w x)^2.
    pub fn square_along(&self, weight: &[f32]) -> f64 {
        weight.iter().zip(self.products_along(weight)).map(|(&w, p)| w as f64 * p).sum()
    }
}
