//! Comparison with the definition in f64.

use super::*;
use crate::reference::{assert_close, assert_same_for_threads, random};

/// Kind of input.
#[derive(Clone, Copy, PartialEq)]
enum First {
    Rows,
    Projected,
    Gathered,
}

struct Case {
    mlp: SharedMlp,
    first: First,
    ends: Option<Vec<u32>>,
    counts: Option<Vec<f32>>,
    x: Vec<f32>,
    source: Vec<u32>,
    offset: Vec<[f32; 3]>,
    parameters: Vec<[Vec<f32>; 3]>,
    dout: Vec<f32>,
}

impl Case {
    /// `groups`: rows in each group; empty for `rows` rows without a maximum.
    fn new(first: First, groups: &[usize], rows: usize, channels: &[usize]) -> Self {
        let ends: Vec<u32> =
            groups.iter().scan(0, |end, &n| Some(std::mem::replace(end, *end + n as u32) + n as u32)).collect();
        let rows = ends.last().map_or(rows, |&end| end as usize);
        let mlp = SharedMlp { rows, channels: channels.to_vec(), epsilon: 1e-3 };
        let layer = |(l, c): (usize, &[usize])| {
            let gamma = random(c[1], 20 + l as u64).into_iter().map(|v| v + 0.7).collect(); // some are negative
            [random(c[0] * c[1], 10 + l as u64), gamma, random(c[1], 30 + l as u64)]
        };
        let parameters = channels.windows(2).enumerate().map(layer).collect();
        let points = rows / 3 + 1;
        let x_len = match first {
            First::Rows => rows * channels[0],
            First::Projected => rows * channels[1],
            First::Gathered => points * channels[1],
        };
        let x = random(x_len, 1).into_iter().map(|v| v + 0.5).collect();
        let outputs = if ends.is_empty() { rows } else { ends.len() };
        let repeated = first != First::Rows;
        Case {
            first,
            counts: repeated.then(|| (0..rows).map(|i| (1 + i % 3) as f32).collect()),
            source: (0..rows).map(|i| (i * 7 % points) as u32).collect(),
            offset: random(rows * 3, 2).as_chunks::<3>().0.to_vec(),
            dout: random(outputs * channels[channels.len() - 1], 3),
            ends: (!ends.is_empty()).then_some(ends),
            x,
            parameters,
            mlp,
        }
    }

    fn layers(&self) -> Vec<MlpLayer<'_>> {
        self.parameters.iter().map(|[weight, gamma, beta]| MlpLayer { weight, gamma, beta }).collect()
    }

    fn input(&self) -> MlpInput<'_> {
        match self.first {
            First::Rows => MlpInput::Rows(&self.x),
            First::Projected => MlpInput::Projected(&self.x),
            First::Gathered => MlpInput::Gathered { features: &self.x, source: &self.source, offset: &self.offset },
        }
    }

    fn groups(&self) -> RowGroups<'_> {
        RowGroups { ends: self.ends.as_deref(), counts: self.counts.as_deref() }
    }

    /// Output, gradient with respect to the input, and the gradients with respect to the parameters side by side.
    fn run(&self) -> ([Vec<f32>; 3], MlpState) {
        let (mut out, mut dx) = (vec![4.0], vec![4.0]);
        let (input, groups, layers) = (self.input(), self.groups(), self.layers());
        let state = self.mlp.forward_train(input, groups, &layers, &mut out);
        let gradients = self.mlp.backward(input, groups, &layers, &state, &self.dout, Some(&mut dx));
        let without = self.mlp.backward(input, groups, &layers, &state, &self.dout, None);
        assert_eq!(format!("{gradients:?}"), format!("{without:?}"), "the other gradients do not depend on dx");
        let gradients = gradients.into_iter().flat_map(|g| [g.weight, g.gamma, g.beta]).collect::<Vec<_>>().concat();
        ([out, dx, gradients], state)
    }

    /// The same in f64, with all rows of all layers, and mean and variance of each layer.
    fn reference(&self) -> ([Vec<f64>; 3], Vec<[Vec<f64>; 2]>) {
        let n = self.mlp.rows;
        let count = |r: usize| self.counts.as_ref().map_or(1.0, |c| c[r] as f64);
        let total: f64 = (0..n).map(count).sum::<f64>().max(1.0);
        let mut a: Vec<Vec<f64>> = vec![self.x.iter().map(|&v| v as f64).collect()];
        let mut hats: Vec<Vec<f64>> = Vec::new();
        let mut statistics = Vec::new();
        for (l, [w, gamma, beta]) in self.parameters.iter().enumerate() {
            let [ci, co] = [self.mlp.channels[l], self.mlp.channels[l + 1]];
            let (mut hat, mut out) = (vec![0.0; n * co], vec![0.0; n * co]);
            let [mut mean, mut variance] = [vec![0.0; co], vec![0.0; co]];
            for c in 0..co {
                let offset = |r: usize| (0..3).map(|k| self.offset[r][k] as f64 * w[c * 3 + k] as f64).sum::<f64>();
                let y = |r: usize| match (l, self.first) {
                    (0, First::Projected) => a[0][r * co + c],
                    (0, First::Gathered) => a[0][self.source[r] as usize * co + c] + offset(r),
                    _ => (0..ci).map(|i| a[l][r * ci + i] * w[c * ci + i] as f64).sum::<f64>(),
                };
                let y: Vec<f64> = (0..n).map(y).collect();
                mean[c] = y.iter().enumerate().map(|(r, y)| count(r) * y).sum::<f64>() / total;
                variance[c] = y.iter().enumerate().map(|(r, y)| count(r) * (y - mean[c]).powi(2)).sum::<f64>() / total;
                for r in 0..n {
                    hat[r * co + c] = (y[r] - mean[c]) / (variance[c] + self.mlp.epsilon).sqrt();
                    out[r * co + c] = (hat[r * co + c] * gamma[c] as f64 + beta[c] as f64).max(0.0);
                }
            }
            hats.push(hat);
            a.push(out);
            statistics.push([mean, variance]);
        }
        let last = self.parameters.len();
        let channels = self.mlp.channels[last];
        let (mut out, mut g) = (vec![0.0; self.dout.len()], vec![0.0; n * channels]);
        for (k, out) in out.iter_mut().enumerate() {
            let (group, c) = (k / channels, k % channels);
            let rows = match &self.ends {
                None => group..group + 1,
                Some(ends) if group == 0 => 0..ends[0] as usize,
                Some(ends) => ends[group - 1] as usize..ends[group] as usize,
            };
            let value = |r: usize| a[last][r * channels + c];
            let best = rows.clone().fold(rows.start, |best, r| if value(r) > value(best) { r } else { best });
            *out = value(best);
            g[best * channels + c] = self.dout[k] as f64;
        }
        let mut gradients = Vec::new();
        for l in (0..last).rev() {
            let [ci, co] = [self.mlp.channels[l], self.mlp.channels[l + 1]];
            let [w, gamma, _] = &self.parameters[l];
            let [mut dw, mut dgamma, mut dbeta] = [vec![0.0; ci * co], vec![0.0; co], vec![0.0; co]];
            let mut before = vec![0.0; if l == 0 { self.x.len() } else { n * ci }];
            for c in 0..co {
                let masked = |r: usize| if a[l + 1][r * co + c] > 0.0 { g[r * co + c] } else { 0.0 };
                dbeta[c] = (0..n).map(masked).sum();
                dgamma[c] = (0..n).map(|r| masked(r) * hats[l][r * co + c]).sum();
                let scale = gamma[c] as f64 / (statistics[l][1][c] + self.mlp.epsilon).sqrt();
                for r in 0..n {
                    let every = dbeta[c] / total + hats[l][r * co + c] * dgamma[c] / total;
                    let dy = scale * (masked(r) - count(r) * every);
                    match (l, self.first) {
                        (0, First::Projected) => before[r * co + c] += dy,
                        (0, First::Gathered) => {
                            before[self.source[r] as usize * co + c] += dy;
                            (0..3).for_each(|k| dw[c * 3 + k] += dy * self.offset[r][k] as f64);
                        }
                        _ => {
                            for i in 0..ci {
                                dw[c * ci + i] += dy * a[l][r * ci + i];
                                before[r * ci + i] += dy * w[c * ci + i] as f64;
                            }
                        }
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
    use First::{Gathered, Projected, Rows};
    let uneven: Vec<usize> = (0..60).map(|i| 1 + i * 5 % 17).collect();
    vec![
        Case::new(Rows, &[], 1, &[1, 1]),
        Case::new(Rows, &[3; 5], 0, &[2, 4]),
        Case::new(Rows, &[7], 0, &[3, 5, 2]),
        Case::new(Rows, &[16; 40], 0, &[4, 16, 17, 32]),
        Case::new(Rows, &[300; 3], 0, &[6, 9, 12]),
        Case::new(Rows, &[], 700, &[5, 18]),
        Case::new(Rows, &uneven, 0, &[19, 8, 24]),
        Case::new(Projected, &[], 130, &[0, 33, 8]),
        Case::new(Projected, &[], 300, &[0, 20]),
        Case::new(Projected, &uneven, 0, &[0, 8, 24]),
        Case::new(Gathered, &uneven, 0, &[3, 16, 16, 32]),
        Case::new(Gathered, &[1], 0, &[3, 5, 4]),
        Case::new(Gathered, &[], 40, &[3, 9]),
    ]
}

#[test]
fn equals_the_definition() {
    for (i, case) in cases().iter().enumerate() {
        let (got, state) = case.run();
        let (want, statistics) = case.reference();
        for (got, [mean, variance]) in state.statistics.iter().zip(&statistics) {
            for (got, want) in got.mean.iter().zip(mean).chain(got.variance.iter().zip(variance)) {
                assert!((got - want).abs() < 2e-6 * want.abs().max(1.0), "case {i}: {got} {want}");
            }
        }
        for (name, got, want) in
            [("out", &got[0], &want[0]), ("dx", &got[1], &want[1]), ("parameters", &got[2], &want[2])]
        {
            // With one or two rows, normalised values depend on the last digits of their difference.
            let want: Vec<f64> = want.iter().copied().chain([1.0]).collect();
            let got: Vec<f32> = got.iter().copied().chain([1.0]).collect();
            assert_close(&got, &want, 2e-5, &format!("{name} of case {i}, {:?}", case.mlp));
        }
    }
}

#[test]
fn fixed_statistics_give_the_same() {
    for case in cases() {
        let ([want, ..], state) = case.run();
        let mut out = vec![1.0];
        case.mlp.forward(case.input(), case.groups(), &case.layers(), &state.statistics, &mut out);
        let want: Vec<f64> = want.into_iter().map(f64::from).collect();
        assert_close(&out, &want, 1e-5, &format!("{:?}", case.mlp));
    }
}

#[test]
fn multiplicity_3_equals_three_rows() {
    let repeat = |rows: &[f32], channels: usize| -> Vec<f32> {
        rows.chunks_exact(channels)
            .enumerate()
            .flat_map(|(r, row)| row.repeat(if r % 4 == 1 { 3 } else { 1 }))
            .collect()
    };
    let mut once = Case::new(First::Rows, &[4; 10], 0, &[5, 6, 7]);
    once.counts = Some((0..40).map(|r| if r % 4 == 1 { 3.0 } else { 1.0 }).collect());
    let mut repeated = Case::new(First::Rows, &[6; 10], 0, &[5, 6, 7]);
    repeated.x = repeat(&once.x, 5);
    let ([out, _, gradients], _) = once.run();
    let ([want, _, want_gradients], _) = repeated.run();
    for (got, want) in [(out, want), (gradients, want_gradients)] {
        assert_close(&got, &want.into_iter().map(f64::from).collect::<Vec<_>>(), 2e-5, "counted and repeated");
    }
}

#[test]
fn the_result_is_bit_equal_for_any_number_of_threads() {
    let uneven: Vec<usize> = (0..700).map(|i| 1 + i * 5 % 17).collect();
    for case in [
        Case::new(First::Rows, &[16; 200], 0, &[9, 16, 32]),
        Case::new(First::Rows, &[], 2000, &[9, 16, 12]),
        Case::new(First::Gathered, &uneven, 0, &[3, 16, 16, 20]),
    ] {
        assert_same_for_threads(|| case.run().0);
    }
}

#[test]
fn no_rows_give_an_empty_output() {
    for mut case in [Case::new(First::Rows, &[], 0, &[3, 4, 5]), Case::new(First::Projected, &[], 0, &[0, 4, 5])] {
        for ends in [None, Some(vec![])] {
            case.ends = ends;
            let ([out, dx, gradients], _) = case.run();
            assert_eq!((out.len(), dx.len()), (0, 0));
            assert!(gradients.iter().all(|&v| v == 0.0));
        }
    }
}

#[test]
fn nan_propagates() {
    for mut case in cases() {
        let statistics = case.run().1.statistics;
        case.x[0] = f32::NAN;
        let [out, _, gradients] = case.run().0;
        let channels = *case.mlp.channels.last().unwrap();
        // Rows that are projections have a NaN in one channel; with a second layer it reaches all of them.
        let all = case.first == First::Rows || case.parameters.len() > 1;
        assert!(out.iter().enumerate().all(|(i, v)| v.is_nan() || !all && i % channels > 0), "{:?}", case.mlp);
        assert!(gradients.iter().any(|v| v.is_nan()));
        let mut out = Vec::new();
        case.mlp.forward(case.input(), case.groups(), &case.layers(), &statistics, &mut out);
        assert!(out[0].is_nan());
        let touched = |group: &[f32]| group.iter().any(|v| v.is_nan());
        let groups = out.chunks_exact(channels).filter(|g| touched(g)).count();
        assert!(groups == 1 || case.first == First::Gathered && groups < 40, "{groups} of {:?}", case.mlp);
    }
}
