//! Focal loss of heat maps with gaussian peaks (Law and Deng, "CornerNet", 2018; OpenPCDet: `FocalLossCenterNet`).

use crate::focal_loss::{exp_of_negative, ln_1p_of_unit};
use crate::simd::vectorized;
use rayon::prelude::*;

/// Probabilities are clamped to `[LEAST, 1 - LEAST]`.
const LEAST: f32 = 1e-4;

/// Cells a task.
const CHUNK: usize = 1 << 13;

/// Cells whose losses are added in f32 lanes before they enter the f64 sum.
const GROUP: usize = 256;

/// `scale` times the sum of the loss over all cells, and its gradient with respect to the logits, which is overwritten.
///
/// With p the clamped sigmoid of the logit: `-(1 - p)^2 ln p` where the heat map is 1, else `-(1 - h)^4 p^2 ln(1 - p)`.
/// A clamped probability has no gradient.
///
/// # Shapes
/// `logits`, `heat_map` (0 to 1) and `gradient` have the same length.
pub fn gaussian_focal_loss(logits: &[f32], heat_map: &[f32], scale: f32, gradient: &mut Vec<f32>) -> f64 {
    assert_eq!(logits.len(), heat_map.len(), "logits and heat map");
    gradient.resize(logits.len(), 0.0);
    let chunks = logits.par_chunks(CHUNK).zip(heat_map.par_chunks(CHUNK)).zip(gradient.par_chunks_mut(CHUNK));
    let sum = |((logits, heat_map), gradient): ((&[f32], &[f32]), &mut [f32])| {
        let groups = logits.chunks(GROUP).zip(heat_map.chunks(GROUP)).zip(gradient.chunks_mut(GROUP));
        groups.map(|((x, h), gradient)| vectorized(|| loss_and_gradient(x, h, scale, gradient))).sum::<f64>()
    };
    let sums: Vec<f64> = chunks.map(sum).collect();
    sums.iter().sum::<f64>() * f64::from(scale)
}

/// The unscaled loss and the scaled gradient of a group of cells.
#[inline(always)]
fn loss_and_gradient(logits: &[f32], heat_map: &[f32], scale: f32, gradient: &mut [f32]) -> f64 {
    let mut losses = [0.0f32; GROUP];
    let losses = &mut losses[..logits.len()];
    let (ln_least, ln_most) = (LEAST.ln(), (-LEAST).ln_1p());
    let cells = logits.iter().zip(heat_map).zip(losses.iter_mut().zip(gradient));
    for ((&x, &h), (loss, gradient)) in cells {
        let e = exp_of_negative(-x.abs());
        let (share, rest) = (1.0 / (1.0 + e), e / (1.0 + e));
        let (p, q) = if x < 0.0 { (rest, share) } else { (share, rest) }; // q = 1 - p; NaN propagates
        let tail = ln_1p_of_unit(e);
        let (ln_p, ln_q) = if x < 0.0 { (x - tail, -tail) } else { (-tail, -x - tail) };
        let (low, high) = (p < LEAST, q < LEAST);
        let (p, ln_p) = if low { (LEAST, ln_least) } else { (p, ln_p) };
        let (q, ln_q) = if low { (1.0 - LEAST, ln_most) } else { (q, ln_q) };
        let (p, ln_p) = if high { (1.0 - LEAST, ln_most) } else { (p, ln_p) };
        let (q, ln_q) = if high { (LEAST, ln_least) } else { (q, ln_q) };
        let far = (1.0 - h) * (1.0 - h);
        // d/dx of q^2 ln p is q^3 - 2 p q^2 ln p, and of p^2 ln q is 2 p^2 q ln q - p^3.
        let (value, slope) = if h == 1.0 {
            (-q * q * ln_p, 2.0 * p * q * q * ln_p - q * q * q)
        } else {
            (-far * far * p * p * ln_q, far * far * (p * p * p - 2.0 * p * p * q * ln_q))
        };
        *loss = value;
        *gradient = if low || high { 0.0 } else { scale * slope };
    }
    losses.iter().map(|&loss| f64::from(loss)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reference::{assert_close, assert_same_for_threads, random};

    fn case(cells: usize) -> (Vec<f32>, Vec<f32>) {
        let logits = random(cells, 1).into_iter().map(|v| v * 12.0).collect();
        let heat_map = random(cells, 2).into_iter().map(|v| if v > 0.8 { 1.0 } else { v.max(0.0) });
        (logits, heat_map.collect())
    }

    #[test]
    fn equals_the_definition() {
        let loss = |x: f64, h: f64| {
            let p = (1.0 / (1.0 + (-x).exp())).clamp(1e-4, 1.0 - 1e-4);
            if h == 1.0 { -(1.0 - p).powi(2) * p.ln() } else { -(1.0 - h).powi(4) * p * p * (1.0 - p).ln() }
        };
        for cells in [0, 1, 7, 300, 20_000] {
            let (logits, heat_map) = case(cells);
            let (mut want, mut slope) = (0.0, Vec::new());
            for (&x, &h) in logits.iter().zip(&heat_map) {
                let (x, h) = (f64::from(x), f64::from(h));
                want += 0.5 * loss(x, h);
                slope.push(0.5 * (loss(x + 1e-5, h) - loss(x - 1e-5, h)) / 2e-5);
            }
            let mut gradient = vec![9.0];
            let got = gaussian_focal_loss(&logits, &heat_map, 0.5, &mut gradient);
            assert!((got - want).abs() <= 1e-6 * want, "{got} {want}");
            assert_close(&gradient, &slope, 3e-6, "gradient");
        }
    }

    #[test]
    fn clamped_probabilities_have_no_gradient() {
        let mut gradient = Vec::new();
        for (x, h, want) in
            [(-20.0, 1.0, -(0.9999f64.powi(2)) * 1e-4f64.ln()), (20.0, 0.0, -(0.9999f64.powi(2)) * 1e-4f64.ln())]
        {
            let got = gaussian_focal_loss(&[x], &[h], 1.0, &mut gradient);
            assert!((got / want - 1.0).abs() < 1e-5 && gradient == [0.0], "{x} {h}: {got} {want} {gradient:?}");
        }
    }

    #[test]
    fn the_result_is_bit_equal_for_any_number_of_threads() {
        let (logits, heat_map) = case(50_000);
        assert_same_for_threads(|| {
            let mut gradient = Vec::new();
            let loss = gaussian_focal_loss(&logits, &heat_map, 0.1, &mut gradient);
            [gradient, vec![loss as f32, (loss * 1e9 % 1.0) as f32]]
        });
    }

    #[test]
    fn nan_propagates() {
        let (mut logits, heat_map) = case(20);
        logits[7] = f32::NAN;
        let mut gradient = Vec::new();
        assert!(gaussian_focal_loss(&logits, &heat_map, 1.0, &mut gradient).is_nan());
        assert_eq!((0..20).filter(|&i| gradient[i].is_nan()).collect::<Vec<_>>(), [7]);
    }
}
