//! Against the definition in f64.

use super::*;
use crate::reference::{assert_close, assert_same_for_threads, random};

struct Case {
    mlp: SharedMlp,
    x: Vec<f32>,
    parameters: Vec<[Vec<f32>; 3]>,
    dout: Vec<f32>,
}

impl Case {
    fn new(groups: usize, group: usize, channels: &[usize]) -> Self {
        let mlp = SharedMlp { rows: groups * group, group, channels: channels.to_vec(), epsilon: 1e-3 };
        let layer = |(l, c): (usize, &[usize])| {
            let gamma = random(c[1], 20 + l as u64).into_iter().map(|v| v + 0.7).collect(); // some are negative
            [random(c[0] * c[1], 10 + l as u64), gamma, random(c[1], 30 + l as u64)]
        };
        let parameters = channels.windows(2).enumerate().map(layer).collect();
        let x = random(mlp.rows * channels[0], 1).into_iter().map(|v| v + 0.5).collect();
        Case { x, parameters, dout: random(mlp.out_len(), 3), mlp }
    }

    fn layers(&self) -> Vec<MlpLayer<'_>> {
        self.parameters.iter().map(|[weight, gamma, beta]| MlpLayer { weight, gamma, beta }).collect()
    }

    /// Output, gradient by the rows, and the gradients by the parameters side by side.
    fn run(&self) -> ([Vec<f32>; 3], MlpState) {
        let (mut out, mut dx) = (vec![4.0], vec![4.0]);
        let state = self.mlp.forward_train(&self.x, &self.layers(), &mut out);
        let gradients = self.mlp.backward(&self.x, &self.layers(), &state, &self.dout, Some(&mut dx));
        let without = self.mlp.backward(&self.x, &self.layers(), &state, &self.dout, None);
        assert_eq!(format!("{gradients:?}"), format!("{without:?}"), "whether dx is wanted changes nothing else");
        let gradients = gradients.into_iter().flat_map(|g| [g.weight, g.gamma, g.beta]).collect::<Vec<_>>().concat();
        ([out, dx, gradients], state)
    }

    fn reference(&self) -> ([Vec<f64>; 3], Vec<[Vec<f64>; 2]>) {
        let n = self.mlp.rows;
        let mut a: Vec<Vec<f64>> = vec![self.x.iter().map(|&v| v as f64).collect()];
        let mut hats: Vec<Vec<f64>> = Vec::new();
        let mut statistics = Vec::new();
        for (l, [w, gamma, beta]) in self.parameters.iter().enumerate() {
            let [ci, co] = [self.mlp.channels[l], self.mlp.channels[l + 1]];
            let (mut hat, mut out) = (vec![0.0; n * co], vec![0.0; n * co]);
            let [mut mean, mut variance] = [vec![0.0; co], vec![0.0; co]];
            for c in 0..co {
                let y = |r: usize| (0..ci).map(|i| a[l][r * ci + i] * w[c * ci + i] as f64).sum::<f64>();
                let y: Vec<f64> = (0..n).map(y).collect();
                mean[c] = y.iter().sum::<f64>() / n as f64;
                variance[c] = y.iter().map(|y| (y - mean[c]).powi(2)).sum::<f64>() / n as f64;
                for r in 0..n {
                    hat[r * co + c] = (y[r] - mean[c]) / (variance[c] + self.mlp.epsilon).sqrt();
                    out[r * co + c] = (hat[r * co + c] * gamma[c] as f64 + beta[c] as f64).max(0.0);
                }
            }
            hats.push(hat);
            a.push(out);
            statistics.push([mean, variance]);
        }
        // Maximum, and the gradient back through it.
        let (s, last) = (self.mlp.group, self.parameters.len());
        let c = self.mlp.channels[last];
        let (mut out, mut g) = (vec![0.0; self.mlp.out_len()], vec![0.0; n * c]);
        for (k, out) in out.iter_mut().enumerate() {
            let at = |r: usize| (k / c * s + r) * c + k % c;
            let best = (1..s).fold(0, |best, r| if a[last][at(r)] > a[last][at(best)] { r } else { best });
            *out = a[last][at(best)];
            g[at(best)] = self.dout[k] as f64;
        }
        let mut gradients = Vec::new();
        for l in (0..last).rev() {
            let [ci, co] = [self.mlp.channels[l], self.mlp.channels[l + 1]];
            let [w, gamma, _] = &self.parameters[l];
            let [mut dw, mut dgamma, mut dbeta] = [vec![0.0; ci * co], vec![0.0; co], vec![0.0; co]];
            let mut before = vec![0.0; n * ci];
            for c in 0..co {
                let masked = |r: usize| if a[l + 1][r * co + c] > 0.0 { g[r * co + c] } else { 0.0 };
                dbeta[c] = (0..n).map(masked).sum();
                dgamma[c] = (0..n).map(|r| masked(r) * hats[l][r * co + c]).sum();
                let scale = gamma[c] as f64 / (statistics[l][1][c] + self.mlp.epsilon).sqrt();
                for r in 0..n {
                    let dy = scale * (masked(r) - dbeta[c] / n as f64 - hats[l][r * co + c] * dgamma[c] / n as f64);
                    for i in 0..ci {
                        dw[c * ci + i] += dy * a[l][r * ci + i];
                        before[r * ci + i] += dy * w[c * ci + i] as f64;
                    }
                }
            }
            gradients.insert(0, [dw, dgamma, dbeta].concat());
            g = before;
        }
        ([out, g, gradients.concat()], statistics)
    }
}

fn cases() -> Vec<Case> {
    vec![
        Case::new(1, 1, &[1, 1]),
        Case::new(5, 3, &[2, 4]),
        Case::new(1, 7, &[3, 5, 2]),
        Case::new(40, 16, &[4, 16, 17, 32]),
        Case::new(3, 300, &[6, 9, 12]),
        Case::new(130, 1, &[20, 33, 8]),
        Case::new(700, 1, &[5, 18]),
        Case::new(33, 20, &[19, 8, 24]),
    ]
}

#[test]
fn equals_the_definition() {
    for case in cases() {
        let (got, state) = case.run();
        let (want, statistics) = case.reference();
        for (got, [mean, variance]) in state.statistics.iter().zip(&statistics) {
            for (got, want) in got.mean.iter().zip(mean).chain(got.variance.iter().zip(variance)) {
                assert!((got - want).abs() < 2e-6 * want.abs().max(1.0), "{:?}: {got} {want}", case.mlp);
            }
        }
        for (name, got, want) in
            [("out", &got[0], &want[0]), ("dx", &got[1], &want[1]), ("parameters", &got[2], &want[2])]
        {
            // With a row or two a normalised value hangs on the last digits of the difference.
            let want: Vec<f64> = want.iter().copied().chain([1.0]).collect();
            let got: Vec<f32> = got.iter().copied().chain([1.0]).collect();
            assert_close(&got, &want, 2e-5, &format!("{name} of {:?}", case.mlp));
        }
    }
}

#[test]
fn fixed_statistics_give_the_same() {
    for case in cases() {
        let ([want, ..], state) = case.run();
        let mut out = vec![1.0];
        case.mlp.forward(&case.x, &case.layers(), &state.statistics, &mut out);
        let want: Vec<f64> = want.into_iter().map(f64::from).collect();
        assert_close(&out, &want, 1e-5, &format!("{:?}", case.mlp));
    }
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    for case in [Case::new(200, 16, &[9, 16, 32]), Case::new(2000, 1, &[9, 16, 12])] {
        assert_same_for_threads(|| case.run().0);
    }
}

#[test]
fn without_rows_nothing_comes_out() {
    for group in [1, 16] {
        let case = Case::new(0, group, &[3, 4, 5]);
        let ([out, dx, gradients], _) = case.run();
        assert_eq!((out.len(), dx.len()), (0, 0));
        assert!(gradients.iter().all(|&v| v == 0.0));
    }
}

#[test]
fn what_is_not_a_number_comes_out() {
    for mut case in cases() {
        let statistics = case.run().1.statistics;
        case.x[0] = f32::NAN;
        let [out, _, gradients] = case.run().0;
        assert!(out.iter().all(|v| v.is_nan()), "{:?}", case.mlp);
        assert!(gradients.iter().any(|v| v.is_nan()));
        let mut out = Vec::new();
        case.mlp.forward(&case.x, &case.layers(), &statistics, &mut out);
        let first = *case.mlp.channels.last().unwrap();
        assert!(out[..first].iter().all(|v| v.is_nan()) && out[first..].iter().all(|v| !v.is_nan()));
    }
}
