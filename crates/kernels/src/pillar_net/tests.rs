//! Comparison with the padded form in f64.

use super::*;
use crate::reference::{assert_close, assert_same_for_threads, random};

struct Case {
    net: PillarNet,
    features: Vec<f32>,
    num_points: Vec<u32>,
    weight: Vec<f32>,
    gamma: Vec<f32>,
    beta: Vec<f32>,
    dout: Vec<f32>,
}

impl Case {
    fn new(inputs: usize, outputs: usize, max_points: usize, num_points: Vec<u32>) -> Self {
        let n = num_points.iter().sum::<u32>() as usize;
        let net = PillarNet { inputs, outputs, max_points, epsilon: 1e-3 };
        // The first values are coordinates, far from zero.
        let features = random(n * inputs, 1);
        let features = features.into_iter().enumerate().map(|(i, v)| if i % inputs < 2 { 30.0 + 20.0 * v } else { v });
        let dout = random(num_points.len() * outputs, 5);
        let weight = random(outputs * inputs, 2);
        let gamma = random(outputs, 3).into_iter().map(|v| v + 0.6).collect(); // some are negative
        Case { net, features: features.collect(), num_points, weight, gamma, beta: random(outputs, 4), dout }
    }

    fn pillars(&self) -> Pillars<'_> {
        Pillars { features: &self.features, num_points: &self.num_points }
    }

    fn parameters(&self) -> PillarParameters<'_> {
        PillarParameters { weight: &self.weight, gamma: &self.gamma, beta: &self.beta }
    }

    fn run(&self) -> ([Vec<f32>; 4], PillarState) {
        let mut out = vec![5.0];
        let state = self.net.forward_train(self.pillars(), self.parameters(), &mut out);
        let g = self.net.backward(self.pillars(), self.parameters(), &state, &self.dout);
        ([out, g.weight, g.gamma, g.beta], state)
    }

    /// Output, mean, variance, and the gradients with respect to the parameters, all rows computed.
    fn reference(&self) -> [Vec<f64>; 6] {
        let (f, c, m) = (self.net.inputs, self.net.outputs, self.net.max_points);
        let pillars = self.num_points.len();
        let mut rows = vec![0.0f64; pillars * m * f];
        let mut from = 0;
        for (p, &count) in self.num_points.iter().enumerate() {
            let count = count as usize * f;
            for k in 0..count {
                rows[p * m * f + k] = self.features[from + k] as f64;
            }
            from += count;
        }
        let n = (pillars * m) as f64;
        let [mut out, mut mean, mut variance] = [vec![0.0; pillars * c], vec![0.0; c], vec![0.0; c]];
        let [mut dw, mut dgamma, mut dbeta] = [vec![0.0; c * f], vec![0.0; c], vec![0.0; c]];
        for channel in 0..c {
            let w = &self.weight[channel * f..][..f];
            let y: Vec<f64> = rows.chunks_exact(f).map(|x| x.iter().zip(w).map(|(x, &w)| x * w as f64).sum()).collect();
            let mu = y.iter().sum::<f64>() / n;
            let var = y.iter().map(|y| (y - mu).powi(2)).sum::<f64>() / n;
            let r = 1.0 / (var + self.net.epsilon).sqrt();
            let (gamma, beta) = (self.gamma[channel] as f64, self.beta[channel] as f64);
            let mut g = vec![0.0; y.len()];
            for p in 0..pillars {
                let z = |row: usize| (y[p * m + row] - mu) * r * gamma + beta;
                let best = (1..m).fold(0, |best, row| if z(row) > z(best) { row } else { best });
                out[p * c + channel] = z(best).max(0.0);
                if z(best) > 0.0 {
                    g[p * m + best] = self.dout[p * c + channel] as f64;
                }
            }
            let s: f64 = g.iter().sum();
            let q: f64 = g.iter().zip(&y).map(|(g, y)| g * (y - mu) * r).sum();
            for (i, x) in rows.chunks_exact(f).enumerate() {
                let dy = gamma * r * (g[i] - s / n - (y[i] - mu) * r * q / n);
                for k in 0..f {
                    dw[channel * f + k] += dy * x[k];
                }
            }
            (mean[channel], variance[channel], dgamma[channel], dbeta[channel]) = (mu, var, q, s);
        }
        [out, mean, variance, dw, dgamma, dbeta]
    }
}

fn cases() -> Vec<Case> {
    let many = random(500, 9).into_iter().map(|v| 1 + ((v + 1.0) * 8.0) as u32).collect();
    vec![
        Case::new(3, 5, 4, vec![2, 4, 1]),
        Case::new(10, 64, 32, vec![1]),
        Case::new(9, 17, 1, vec![1, 1, 1]),
        Case::new(4, 33, 8, vec![8, 0, 3, 8, 8]),
        Case::new(10, 64, 17, many),
        Case::new(1, 1, 3, vec![0, 0]),
    ]
}

#[test]
fn equals_the_padded_form() {
    for case in cases() {
        let ([out, dw, dgamma, dbeta], state) = case.run();
        let [want, mean, variance, want_dw, want_dgamma, want_dbeta] = case.reference();
        for (got, want) in
            state.statistics.mean.iter().zip(&mean).chain(state.statistics.variance.iter().zip(&variance))
        {
            assert!((got - want).abs() <= 1e-11 * want.abs().max(1.0), "{:?}: {got} {want}", case.net);
        }
        for (name, got, want, tolerance) in [
            ("out", out, want, 1e-5),
            ("dgamma", dgamma, want_dgamma, 1e-5),
            ("dbeta", dbeta, want_dbeta, 1e-6),
            ("dw", dw, want_dw, 1e-5),
        ] {
            assert_close(&got, &want, tolerance, &format!("{name} of {:?}", case.net));
        }
        let mut out = Vec::new();
        case.net.forward(case.pillars(), case.parameters(), &state.statistics, &mut out);
        assert_eq!(out, case.run().0[0], "the same statistics, the same values");
    }
}

#[test]
fn the_result_is_bit_equal_for_any_number_of_threads() {
    let case = Case::new(9, 40, 17, random(3000, 9).into_iter().map(|v| 1 + ((v + 1.0) * 8.0) as u32).collect());
    assert_same_for_threads(|| case.run().0);
}

#[test]
fn no_pillars_give_an_empty_output() {
    let case = Case::new(10, 64, 32, vec![]);
    let ([out, dw, dgamma, dbeta], state) = case.run();
    assert!(out.is_empty());
    assert!(dw.iter().chain(&dgamma).chain(&dbeta).all(|&v| v == 0.0));
    assert_eq!((state.count, state.statistics.mean), (0, vec![0.0; 64]));
}

#[test]
fn nan_propagates() {
    let mut case = Case::new(3, 5, 4, vec![2, 4, 1]);
    let statistics = case.run().1.statistics;
    case.features[3] = f32::NAN; // second point of the first pillar
    assert!(case.run().0.iter().all(|values| values.iter().all(|v| v.is_nan() || values.len() == 5)));
    let mut out = Vec::new();
    case.net.forward(case.pillars(), case.parameters(), &statistics, &mut out);
    assert!(out[..5].iter().all(|v| v.is_nan()) && out[5..].iter().all(|v| !v.is_nan()));
}
