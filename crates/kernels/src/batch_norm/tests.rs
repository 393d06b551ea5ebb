//! Comparison with the definition in f64.

use super::*;
use crate::reference::{assert_close, assert_same_for_threads, random};

fn shapes() -> Vec<BatchNorm> {
    let mut all = Vec::new();
    for [batch, channels, pixels] in
        [[1, 1, 1], [7, 3, 1], [1, 2, 40], [3, 5, 33], [2, 1, 1000], [40, 70, 1], [5, 9, 4], [1, 3, 31], [2, 2, 100]]
    {
        all.extend([false, true].map(|relu| BatchNorm { batch, channels, pixels, epsilon: 1e-3, relu }));
    }
    all
}

struct Want {
    mean: Vec<f64>,
    variance: Vec<f64>,
    y: Vec<f64>,
    dx: Vec<f64>,
    dgamma: Vec<f64>,
    dbeta: Vec<f64>,
}

fn reference(norm: &BatchNorm, x: &[f32], dy: &[f32], gamma: &[f32], beta: &[f32]) -> Want {
    let c = norm.channels;
    let [mut mean, mut variance, mut dgamma, mut dbeta] = [vec![0.0; c], vec![0.0; c], vec![0.0; c], vec![0.0; c]];
    let (mut y, mut dx) = (vec![0.0; x.len()], vec![0.0; x.len()]);
    for channel in 0..c {
        let places: Vec<usize> = (0..x.len()).filter(|i| i / norm.pixels % c == channel).collect();
        let n = places.len() as f64;
        let m = places.iter().map(|&i| x[i] as f64).sum::<f64>() / n;
        let v = places.iter().map(|&i| (x[i] as f64 - m).powi(2)).sum::<f64>() / n;
        let r = 1.0 / (v + norm.epsilon).sqrt();
        let hat = |i: usize| (x[i] as f64 - m) * r;
        let z = |i: usize| hat(i) * gamma[channel] as f64 + beta[channel] as f64;
        let g = |i: usize| if norm.relu && z(i) <= 0.0 { 0.0 } else { dy[i] as f64 };
        let (s, p) = places.iter().fold((0.0, 0.0), |(s, p), &i| (s + g(i), p + g(i) * hat(i)));
        for &i in &places {
            y[i] = if norm.relu { z(i).max(0.0) } else { z(i) };
            dx[i] = gamma[channel] as f64 * r * (g(i) - s / n - hat(i) * p / n);
        }
        (mean[channel], variance[channel], dgamma[channel], dbeta[channel]) = (m, v, p, s);
    }
    Want { mean, variance, y, dx, dgamma, dbeta }
}

fn inputs(norm: &BatchNorm) -> [Vec<f32>; 4] {
    let gamma = random(norm.channels, 3).into_iter().map(|v| v + 1.5).collect();
    // Two channels of images are far from zero, where sums of squares cancel.
    let x = random(norm.len(), 1);
    let x = x.into_iter().enumerate().map(|(i, v)| if i / norm.pixels % 3 == 1 { v + 50.0 } else { v }).collect();
    [x, random(norm.len(), 2), gamma, random(norm.channels, 4)]
}

#[test]
fn equals_the_definition() {
    for norm in shapes() {
        let [x, dy, gamma, beta] = inputs(&norm);
        let want = reference(&norm, &x, &dy, &gamma, &beta);
        let (mut y, mut dx) = (Vec::new(), vec![1.0; 3]);
        let statistics = norm.forward_train(&x, &gamma, &beta, &mut y);
        let (dgamma, dbeta) = norm.backward((&x, &dy), (&gamma, &beta), &statistics, &mut dx);
        for (name, got, want) in
            [("mean", &statistics.mean, &want.mean), ("variance", &statistics.variance, &want.variance)]
        {
            for (got, want) in got.iter().zip(want) {
                assert!((got - want).abs() <= 1e-10 * want.abs().max(1.0), "{name} of {norm:?}: {got} {want}");
            }
        }
        // In single precision a value at 50 has an error of 4e-6, and one lone value makes a slope of 1 /
        // sqrt(epsilon).
        for (name, got, want, tolerance) in [
            ("y", &y, &want.y, 2e-5),
            ("dx", &dx, &want.dx, 1e-4),
            ("dgamma", &dgamma, &want.dgamma, 2e-5),
            ("dbeta", &dbeta, &want.dbeta, 1e-6),
        ] {
            let scale = if name == "dx" { want.iter().fold(1.0f64, |m, v| m.max(v.abs())) } else { 1.0 };
            let want: Vec<f64> = want.iter().map(|v| v / scale).chain([1.0]).collect();
            let got: Vec<f32> = got.iter().map(|v| (*v as f64 / scale) as f32).chain([1.0]).collect();
            assert_close(&got, &want, tolerance, &format!("{name} of {norm:?}"));
        }
        let mut again = Vec::new();
        norm.forward(&x, &gamma, &beta, &statistics, &mut again);
        assert_eq!(y, again, "the same statistics, the same values");
    }
}

#[test]
fn the_result_is_bit_equal_for_any_number_of_threads() {
    for [batch, channels, pixels] in [[2, 30, 700], [300, 50, 1], [60, 7, 9]] {
        let norm = BatchNorm { batch, channels, pixels, epsilon: 1e-3, relu: true };
        let [x, dy, gamma, beta] = inputs(&norm);
        assert_same_for_threads(|| {
            let (mut y, mut dx) = (Vec::new(), Vec::new());
            let statistics = norm.forward_train(&x, &gamma, &beta, &mut y);
            let (dgamma, dbeta) = norm.backward((&x, &dy), (&gamma, &beta), &statistics, &mut dx);
            [y, dx, dgamma, dbeta]
        });
    }
}

#[test]
fn nan_propagates_in_its_channel() {
    for norm in shapes() {
        let [mut x, dy, gamma, beta] = inputs(&norm);
        x[0] = f32::NAN;
        let (mut y, mut dx) = (Vec::new(), Vec::new());
        let statistics = norm.forward_train(&x, &gamma, &beta, &mut y);
        let (dgamma, _) = norm.backward((&x, &dy), (&gamma, &beta), &statistics, &mut dx);
        for i in 0..x.len() {
            let first = i / norm.pixels % norm.channels == 0;
            assert_eq!((y[i].is_nan(), dx[i].is_nan()), (first, first), "{norm:?}");
        }
        assert!(dgamma[0].is_nan() && dgamma[1..].iter().all(|v| !v.is_nan()));
    }
}

#[test]
fn nothing_gives_nothing() {
    let norm = BatchNorm { batch: 0, channels: 2, pixels: 5, epsilon: 1e-3, relu: true };
    let mut y = vec![1.0];
    let statistics = norm.forward_train(&[], &[1.0; 2], &[0.0; 2], &mut y);
    assert_eq!((y.len(), statistics.mean), (0, vec![0.0; 2]));
}
