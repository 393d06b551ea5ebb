//! Sigmoid focal loss (Lin et al., "Focal Loss for Dense Object Detection", 2017; OpenPCDet:
//! `SigmoidFocalClassificationLoss`).

use crate::simd::vectorized;
use rayon::prelude::*;

/// Weight of a positive entry; a negative one has 1 - alpha.
const ALPHA: f32 = 0.25;

/// Logits a task.
const CHUNK: usize = 1 << 13;

/// Logits that are processed after each lookup of their targets.
const GROUP: usize = 256;

/// The weighted sum over all entries of the loss with alpha 0.25 and gamma 2, and its gradient with respect to the
/// logits, which is overwritten.
///
/// # Shapes
/// `logits`, `gradient`: `[rows, classes]`; `labels`: `[rows]`, 0 or less for background, k for the class with index k
/// - 1; `weights`: `[rows]`.
pub fn sigmoid_focal_loss(
    logits: &[f32],
    classes: usize,
    labels: &[i32],
    weights: &[f32],
    gradient: &mut Vec<f32>,
) -> f64 {
    let rows = labels.len();
    assert_eq!((logits.len(), weights.len()), (rows * classes, rows), "logits and weights of {rows} rows");
    gradient.resize(logits.len(), 0.0);
    if logits.is_empty() {
        return 0.0;
    }
    let rows_a_task = (CHUNK / classes).max(1);
    let chunks = logits.par_chunks(rows_a_task * classes).zip(gradient.par_chunks_mut(rows_a_task * classes));
    let rows = labels.par_chunks(rows_a_task).zip(weights.par_chunks(rows_a_task));
    let sums: Vec<f64> = chunks
        .zip(rows)
        .map(|((logits, gradient), (labels, weights))| {
            let entry = |i: usize| {
                let (row, class) = (i / classes, i % classes);
                (if labels[row] == class as i32 + 1 { 1.0 } else { 0.0 }, weights[row])
            };
            let (mut targets, mut scales) = ([0.0f32; GROUP], [0.0f32; GROUP]);
            let mut sum = 0.0;
            for (group, (logits, gradient)) in logits.chunks(GROUP).zip(gradient.chunks_mut(GROUP)).enumerate() {
                for i in 0..logits.len() {
                    (targets[i], scales[i]) = entry(group * GROUP + i);
                }
                sum += vectorized(|| loss_and_gradient(logits, &targets, &scales, gradient));
            }
            sum
        })
        .collect();
    sums.iter().sum()
}

#[inline(always)]
fn loss_and_gradient(logits: &[f32], targets: &[f32], scales: &[f32], gradient: &mut [f32]) -> f64 {
    let mut losses = [0.0f32; GROUP];
    let losses = &mut losses[..logits.len()];
    let entries = logits.iter().zip(targets).zip(scales);
    for (((&x, &t), &scale), (loss, gradient)) in entries.zip(losses.iter_mut().zip(gradient)) {
        let e = exp_of_negative(-x.abs());
        let p = if x >= 0.0 { 1.0 } else { e } / (1.0 + e);
        let cross_entropy = if x < 0.0 { 0.0 } else { x } - x * t + ln_1p_of_unit(e);
        let alpha = t * (2.0 * ALPHA - 1.0) + (1.0 - ALPHA);
        let miss = t + p - 2.0 * t * p; // t (1 - p) + (1 - t) p
        // d miss / dx = (1 - 2 t) p (1 - p); d cross_entropy / dx = p - t
        let slope = 2.0 * (1.0 - 2.0 * t) * p * (1.0 - p) * cross_entropy + miss * (p - t);
        *loss = scale * (alpha * miss * miss * cross_entropy);
        *gradient = scale * (alpha * miss * slope);
    }
    losses.iter().map(|&loss| loss as f64).sum()
}

/// e^x for x <= 0 to about 1 ulp; x is clamped to -87. Cody and Waite's range reduction and a polynomial, without
/// branches for vectorisation.
#[inline(always)]
pub(crate) fn exp_of_negative(x: f32) -> f32 {
    const ROUND: f32 = 12_582_912.0; // 1.5 * 2^23: adding it rounds to whole numbers
    let x = if x < -87.0 { -87.0 } else { x };
    let shifted = x * std::f32::consts::LOG2_E + ROUND;
    let n = shifted - ROUND;
    let r = x - n * 0.693_359_4 - n * -2.121_944_4e-4; // ln 2 in two parts
    let series = [1.987_569_2e-4, 1.398_199_9e-3, 8.333_452e-3, 4.166_579_6e-2, 1.666_666_5e-1, 0.5];
    let polynomial = series.iter().fold(0.0, |sum, c| sum * r + c) * r * r + r + 1.0;
    let power = f32::from_bits((shifted.to_bits() << 23).wrapping_add(127 << 23)); // 2^n
    polynomial * power
}

/// ln(1 + e) for e in [0, 1], to about 2 ulp, also for small e: 2 artanh(e / (2 + e)).
#[inline(always)]
pub(crate) fn ln_1p_of_unit(e: f32) -> f32 {
    let s = e / (2.0 + e);
    let z = s * s;
    let series = [1.0 / 15.0, 1.0 / 13.0, 1.0 / 11.0, 1.0 / 9.0, 1.0 / 7.0, 1.0 / 5.0, 1.0 / 3.0, 1.0];
    2.0 * s * series.iter().fold(0.0, |sum, c| sum * z + c)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reference::{assert_close, assert_same_for_threads, random};

    #[test]
    fn the_functions_are_exact() {
        for i in 0..200_000 {
            let x = -(i as f32) * 4.35e-4;
            let want = (x as f64).exp();
            let error = (exp_of_negative(x) as f64 / want - 1.0).abs();
            assert!(error < 2e-7, "exp({x}): {error:e}");
            let want = want.ln_1p();
            let error = (ln_1p_of_unit((x as f64).exp() as f32) as f64 / want - 1.0).abs();
            assert!(error < 3e-7, "ln(1 + exp({x})): {error:e}");
        }
        assert_eq!((exp_of_negative(0.0), exp_of_negative(-0.0), ln_1p_of_unit(0.0)), (1.0, 1.0, 0.0));
        assert!(exp_of_negative(f32::NEG_INFINITY) < 1e-37);
    }

    fn case(rows: usize, classes: usize) -> (Vec<f32>, Vec<i32>, Vec<f32>) {
        let logits = random(rows * classes, 1).into_iter().map(|v| v * 9.0).collect();
        let labels = random(rows, 2).into_iter().map(|v| ((v + 0.3) * classes as f32).floor() as i32);
        let weights = random(rows, 3).into_iter().map(|v| if v < -0.5 { 0.0 } else { v + 1.0 });
        (logits, labels.map(|l| l.clamp(-1, classes as i32)).collect(), weights.collect())
    }

    #[test]
    fn equals_the_definition() {
        for (rows, classes) in [(1, 1), (7, 3), (300, 1), (5000, 3), (0, 3)] {
            let (logits, labels, weights) = case(rows, classes);
            let focal = |x: f64, t: f64| {
                let p = 1.0 / (1.0 + (-x).exp());
                let cross_entropy = x.max(0.0) - x * t + (-x.abs()).exp().ln_1p();
                (0.25 * t + 0.75 * (1.0 - t)) * (t * (1.0 - p) + (1.0 - t) * p).powi(2) * cross_entropy
            };
            let (mut want, mut slope) = (0.0, Vec::new());
            for (i, &x) in logits.iter().enumerate() {
                let (row, class) = (i / classes, i % classes);
                let t = if labels[row] == class as i32 + 1 { 1.0 } else { 0.0 };
                let (x, w) = (x as f64, weights[row] as f64);
                want += w * focal(x, t);
                slope.push(w * (focal(x + 1e-5, t) - focal(x - 1e-5, t)) / 2e-5);
            }
            let mut gradient = vec![9.0];
            let loss = sigmoid_focal_loss(&logits, classes, &labels, &weights, &mut gradient);
            assert!((loss - want).abs() <= 1e-6 * want, "{loss} {want}");
            assert_close(&gradient, &slope, 3e-6, "gradient");
        }
    }

    #[test]
    fn the_result_is_bit_equal_for_any_number_of_threads() {
        let (logits, labels, weights) = case(20_000, 3);
        assert_same_for_threads(|| {
            let mut gradient = Vec::new();
            let loss = sigmoid_focal_loss(&logits, 3, &labels, &weights, &mut gradient);
            [gradient, vec![loss as f32, (loss * 1e9 % 1.0) as f32]]
        });
    }

    #[test]
    fn nan_propagates() {
        let (mut logits, labels, weights) = case(20, 2);
        logits[7] = f32::NAN;
        let mut gradient = Vec::new();
        assert!(sigmoid_focal_loss(&logits, 2, &labels, &weights, &mut gradient).is_nan());
        assert_eq!((0..40).filter(|&i| gradient[i].is_nan()).collect::<Vec<_>>(), [7]);
        for extreme in [f32::INFINITY, f32::NEG_INFINITY, 1e30, -1e30] {
            let mut gradient = Vec::new();
            let loss = sigmoid_focal_loss(&[extreme], 1, &[0], &[1.0], &mut gradient);
            assert!(!gradient[0].is_nan() || extreme.is_infinite(), "{extreme}: {loss} {gradient:?}");
        }
    }
}
