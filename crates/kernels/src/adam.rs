//! Adam with decoupled weight decay (Loshchilov & Hutter, "Decoupled Weight Decay Regularization", 2019), and clipping
//! by the global norm.

use crate::simd::vectorized;
use rayon::prelude::*;

/// Values a task.
const CHUNK: usize = 1 << 14;

/// One step of the optimiser, the same for all parameters.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AdamStep {
    /// Learning rate of this step.
    pub learning_rate: f64,
    /// Decay of the running mean of the gradients (beta1). It may change between steps; the bias correction uses this
    /// step's value.
    pub beta1: f64,
    /// Decay of the running mean of the squared gradients (beta2).
    pub beta2: f64,
    /// Added to the denominator.
    pub epsilon: f64,
    /// Decoupled weight decay: each value is multiplied by 1 - lr * weight decay before the step.
    pub weight_decay: f64,
    /// Number of this step, from 1.
    pub step: u64,
    /// Factor of every gradient, applied first; see [`GradientNorm::clip_scale`].
    pub gradient_scale: f64,
}

/// A parameter, its gradient and its moments, all of one length.
#[derive(Debug)]
pub struct Parameter<'a> {
    /// The values, changed in place.
    pub value: &'a mut [f32],
    /// Their gradient. Without one, only the weight decay is applied.
    pub gradient: Option<&'a [f32]>,
    /// Running mean of the gradient, zero before the first step.
    pub exp_avg: &'a mut [f32],
    /// Running mean of its square, zero before the first step.
    pub exp_avg_sq: &'a mut [f32],
}

impl AdamStep {
    /// Updates all parameters.
    pub fn apply(&self, parameters: Vec<Parameter<'_>>) {
        let mut chunks = Vec::new();
        for Parameter { value, gradient, exp_avg, exp_avg_sq } in parameters {
            let n = value.len();
            assert!(gradient.is_none_or(|g| g.len() == n), "length of the gradient of {n} values");
            assert!(
                gradient.is_none() || (exp_avg.len(), exp_avg_sq.len()) == (n, n),
                "length of the moments of {n} values"
            );
            match gradient {
                None => chunks.extend(value.chunks_mut(CHUNK).map(Chunk::Decay)),
                Some(gradient) => {
                    let moments = exp_avg.chunks_mut(CHUNK).zip(exp_avg_sq.chunks_mut(CHUNK));
                    let values = value.chunks_mut(CHUNK).zip(gradient.chunks(CHUNK));
                    chunks.extend(values.zip(moments).map(|((v, g), (m, s))| Chunk::Move(v, g, m, s)));
                }
            }
        }
        let step = self.step as f64;
        let numbers = Coefficients {
            scale: self.gradient_scale as f32,
            decay: (1.0 - self.learning_rate * self.weight_decay) as f32,
            beta1: self.beta1 as f32,
            rest1: (1.0 - self.beta1) as f32,
            beta2: self.beta2 as f32,
            rest2: (1.0 - self.beta2) as f32,
            root: (1.0 - self.beta2.powf(step)).sqrt() as f32,
            epsilon: self.epsilon as f32,
            rate: (self.learning_rate / (1.0 - self.beta1.powf(step))) as f32,
        };
        chunks.into_par_iter().for_each(|chunk| vectorized(|| numbers.update(chunk)));
    }
}

enum Chunk<'a> {
    Decay(&'a mut [f32]),
    Move(&'a mut [f32], &'a [f32], &'a mut [f32], &'a mut [f32]),
}

/// The coefficients of a step in single precision.
#[derive(Clone, Copy)]
struct Coefficients {
    scale: f32,
    decay: f32,
    beta1: f32,
    rest1: f32,
    beta2: f32,
    rest2: f32,
    root: f32,
    epsilon: f32,
    rate: f32,
}

impl Coefficients {
    #[inline(always)]
    fn update(&self, chunk: Chunk<'_>) {
        match chunk {
            Chunk::Decay(values) => values.iter_mut().for_each(|value| *value *= self.decay),
            Chunk::Move(values, gradients, means, squares) => {
                for (((value, gradient), mean), square) in values.iter_mut().zip(gradients).zip(means).zip(squares) {
                    let g = gradient * self.scale;
                    *mean = *mean * self.beta1 + g * self.rest1;
                    *square = *square * self.beta2 + g * g * self.rest2;
                    let denominator = square.sqrt() / self.root + self.epsilon;
                    *value = *value * self.decay - *mean / denominator * self.rate;
                }
            }
        }
    }
}

/// The global L2 norm of all gradients.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GradientNorm {
    /// The norm before clipping.
    pub total: f64,
    /// Index of the first gradient that holds a NaN or an infinity.
    pub not_finite: Option<usize>,
}

impl GradientNorm {
    /// The norm of these gradients; squares and sums are f64.
    pub fn of(gradients: &[&[f32]]) -> Self {
        let squares = |chunk: &[f32]| {
            vectorized(|| {
                let mut lanes = [0.0f64; 16];
                let (whole, rest) = chunk.as_chunks::<16>();
                for values in whole {
                    for (lane, &value) in lanes.iter_mut().zip(values) {
                        *lane += value as f64 * value as f64;
                    }
                }
                lanes.iter().sum::<f64>() + rest.iter().map(|&v| v as f64 * v as f64).sum::<f64>()
            })
        };
        let of_one =
            |gradient: &&[f32]| gradient.par_chunks(CHUNK).map(squares).collect::<Vec<f64>>().iter().sum::<f64>();
        let sums: Vec<f64> = gradients.par_iter().map(of_one).collect();
        // Squares of finite f32 do not overflow f64.
        GradientNorm { total: sums.iter().sum::<f64>().sqrt(), not_finite: sums.iter().position(|s| !s.is_finite()) }
    }

    /// Factor of the gradients that limits their norm to `max_norm`, as in `torch.nn.utils.clip_grad_norm_`.
    pub fn clip_scale(&self, max_norm: f64) -> f64 {
        (max_norm / (self.total + 1e-6)).min(1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reference::{assert_close, assert_same_for_threads, random};

    const STEP: AdamStep = AdamStep {
        learning_rate: 0.003,
        beta1: 0.9,
        beta2: 0.99,
        epsilon: 1e-8,
        weight_decay: 0.01,
        step: 1,
        gradient_scale: 0.5,
    };

    #[test]
    fn equals_the_definition_over_some_steps() {
        let n = CHUNK + 77;
        let mut value = random(n, 1);
        let (mut exp_avg, mut exp_avg_sq) = (vec![0.0; n], vec![0.0; n]);
        let mut want: Vec<f64> = value.iter().map(|&v| v as f64).collect();
        let (mut m, mut s) = (vec![0.0; n], vec![0.0; n]);
        for step in 1..=4 {
            let gradient = random(n, 10 + step);
            let now = AdamStep { step, beta1: 0.9 - 0.01 * step as f64, ..STEP };
            let [value, exp_avg, exp_avg_sq] = [&mut value, &mut exp_avg, &mut exp_avg_sq];
            now.apply(vec![Parameter { value, gradient: Some(&gradient), exp_avg, exp_avg_sq }]);
            for i in 0..n {
                let g = gradient[i] as f64 * 0.5;
                m[i] = now.beta1 * m[i] + (1.0 - now.beta1) * g;
                s[i] = 0.99 * s[i] + 0.01 * g * g;
                let mean = m[i] / (1.0 - now.beta1.powf(step as f64));
                let square: f64 = s[i] / (1.0 - 0.99f64.powf(step as f64));
                want[i] = want[i] * (1.0 - 0.003 * 0.01) - 0.003 * mean / (square.sqrt() + 1e-8);
            }
        }
        assert_close(&value, &want, 1e-6, "values");
        assert_close(&exp_avg, &m, 1e-6, "exp_avg");
        assert_close(&exp_avg_sq, &s, 1e-6, "exp_avg_sq");
    }

    #[test]
    fn without_a_gradient_only_weight_decay_is_applied() {
        let mut value = vec![2.0f32; 3];
        STEP.apply(vec![Parameter { value: &mut value, gradient: None, exp_avg: &mut [], exp_avg_sq: &mut [] }]);
        assert_eq!(value, [2.0 * (1.0 - 3e-5f64) as f32; 3]);
    }

    #[test]
    fn norm_over_all_gradients() {
        let (a, b) = (random(CHUNK + 3, 1), random(5, 2));
        let want: f64 = a.iter().chain(&b).map(|&v| v as f64 * v as f64).sum();
        let norm = GradientNorm::of(&[&a, &[], &b]);
        assert!((norm.total - want.sqrt()).abs() < 1e-12 * want);
        assert_eq!(norm.not_finite, None);
        assert_eq!(GradientNorm { total: 20.0, not_finite: None }.clip_scale(10.0), 10.0 / 20.000001);
        assert_eq!(GradientNorm::of(&[&[3.0, 4.0]]).clip_scale(10.0), 1.0);
        assert_eq!(GradientNorm::of(&[]), GradientNorm { total: 0.0, not_finite: None });
        assert_eq!(GradientNorm::of(&[&[1.0], &[1.0, f32::NAN], &[f32::INFINITY]]).not_finite, Some(1));
        assert_eq!(GradientNorm::of(&[&[f32::MAX; 4]]).not_finite, None);
    }

    #[test]
    fn the_result_is_bit_equal_for_any_number_of_threads() {
        let gradient = random(5 * CHUNK + 9, 3);
        assert_same_for_threads(|| {
            let mut value = random(gradient.len(), 1);
            let (mut exp_avg, mut exp_avg_sq) = (vec![0.1; value.len()], vec![0.2; value.len()]);
            let scale = GradientNorm::of(&[&gradient]).clip_scale(1.0);
            AdamStep { gradient_scale: scale, ..STEP }.apply(vec![Parameter {
                value: &mut value,
                gradient: Some(&gradient),
                exp_avg: &mut exp_avg,
                exp_avg_sq: &mut exp_avg_sq,
            }]);
            [value, exp_avg, exp_avg_sq]
        });
    }

    #[test]
    fn nan_propagates() {
        let (mut value, mut exp_avg, mut exp_avg_sq) = (vec![1.0; 40], vec![0.0; 40], vec![0.0; 40]);
        let mut gradient = vec![1.0; 40];
        gradient[20] = f32::NAN;
        let [value_, exp_avg, exp_avg_sq] = [&mut value, &mut exp_avg, &mut exp_avg_sq];
        STEP.apply(vec![Parameter { value: value_, gradient: Some(&gradient), exp_avg, exp_avg_sq }]);
        assert_eq!((0..40).filter(|&i| value[i].is_nan()).collect::<Vec<_>>(), [20]);
    }
}
