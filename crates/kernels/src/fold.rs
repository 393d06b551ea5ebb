//! Folding of a batch norm with fixed statistics into the preceding convolution.

use crate::batch_norm::Statistics;

/// Weights and bias of the convolution with the batch norm folded in.
#[derive(Clone, Debug, PartialEq)]
pub struct Folded {
    /// In the layout of the given weights.
    pub weight: Vec<f32>,
    /// Bias, `[outputs]`.
    pub bias: Vec<f32>,
}

/// Parameters and statistics of a batch norm.
#[derive(Clone, Copy, Debug)]
pub struct NormParameters<'a> {
    /// Scale, `[channels]`.
    pub gamma: &'a [f32],
    /// Shift, `[channels]`.
    pub beta: &'a [f32],
    /// Running statistics.
    pub statistics: &'a Statistics,
    /// Added to the variance.
    pub epsilon: f64,
}

impl NormParameters<'_> {
    /// Folds the norm into the preceding convolution with weights `[outputs, ...]` (3x3, 1x1, linear).
    pub fn fold_into_conv(&self, weight: &[f32]) -> Folded {
        self.fold(weight, weight.len() / self.gamma.len().max(1), |at, of_an_output| at / of_an_output)
    }

    /// Folds the norm into the preceding transposed convolution with weights `[inputs, outputs, stride, stride]`.
    pub fn fold_into_transposed(&self, weight: &[f32], stride: usize) -> Folded {
        let outputs = self.gamma.len();
        self.fold(weight, stride * stride, |at, of_a_pair| at / of_a_pair % outputs)
    }

    fn fold(&self, weight: &[f32], group: usize, output: impl Fn(usize, usize) -> usize) -> Folded {
        let Statistics { mean, variance } = self.statistics;
        assert!(
            group > 0 && weight.len().is_multiple_of(group * self.gamma.len()),
            "number of weights for {} outputs",
            self.gamma.len()
        );
        let scale: Vec<f64> =
            self.gamma.iter().zip(variance).map(|(&g, v)| g as f64 / (v + self.epsilon).sqrt()).collect();
        let scaled = |(at, &w): (usize, &f32)| (w as f64 * scale[output(at, group)]) as f32;
        let bias =
            self.beta.iter().zip(&scale).zip(mean).map(|((&beta, scale), mean)| (beta as f64 - mean * scale) as f32);
        Folded { weight: weight.iter().enumerate().map(scaled).collect(), bias: bias.collect() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::epilogue::Epilogue;
    use crate::reference::{assert_close, random};
    use crate::{BatchNorm, Conv3x3, TransposedConv};

    fn norm(channels: usize) -> (Vec<f32>, Vec<f32>, Statistics) {
        let as_f64 = |v: Vec<f32>| v.into_iter().map(f64::from).collect::<Vec<_>>();
        let variance = as_f64(random(channels, 4)).into_iter().map(|v| v * v + 0.1).collect();
        (random(channels, 1), random(channels, 2), Statistics { mean: as_f64(random(channels, 3)), variance })
    }

    fn check(
        plain: &[f32],
        folded: &[f32],
        outputs: usize,
        pixels: usize,
        (gamma, beta, statistics): (&[f32], &[f32], &Statistics),
    ) {
        let batch = plain.len() / (outputs * pixels);
        let norm = BatchNorm { batch, channels: outputs, pixels, epsilon: 1e-3, relu: true };
        let mut want = Vec::new();
        norm.forward(plain, gamma, beta, statistics, &mut want);
        let want: Vec<f64> = want.into_iter().map(f64::from).collect();
        assert_close(folded, &want, 3e-6, "folded");
    }

    #[test]
    fn equals_convolution_and_norm() {
        let (gamma, beta, statistics) = norm(5);
        let parameters = NormParameters { gamma: &gamma, beta: &beta, statistics: &statistics, epsilon: 1e-3 };
        let conv =
            Conv3x3 { batch: 2, inputs: 3, outputs: 5, height: 6, width: 7, stride: 2, algorithm: Default::default() };
        let (x, w) = (random(conv.x_len(), 5), random(conv.weight_len(), 6));
        let (mut plain, mut both) = (Vec::new(), Vec::new());
        let Folded { weight, bias } = parameters.fold_into_conv(&w);
        conv.forward(&x, &conv.pack(&w), Epilogue::default(), &mut plain);
        conv.forward(&x, &conv.pack(&weight), Epilogue { bias: Some(&bias), relu: true }, &mut both);
        check(&plain, &both, 5, 12, (&gamma, &beta, &statistics));

        let conv = TransposedConv { batch: 2, inputs: 3, outputs: 5, height: 3, width: 4, stride: 2 };
        let (x, w) = (random(conv.x_len(), 5), random(conv.weight_len(), 6));
        let Folded { weight, bias } = parameters.fold_into_transposed(&w, 2);
        conv.forward(&x, &conv.pack(&w), Epilogue::default(), &mut plain);
        conv.forward(&x, &conv.pack(&weight), Epilogue { bias: Some(&bias), relu: true }, &mut both);
        check(&plain, &both, 5, 48, (&gamma, &beta, &statistics));
    }
}
