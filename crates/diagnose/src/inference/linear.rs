//! Linear causes from sums of frames: fits, gains on other frames, standard errors from the scatter of frames.

use nalgebra::{DMatrix, DVector};

/// Sums of one frame in units of its noise: X' W X and X' W y.
#[derive(Clone, Debug)]
pub struct LinearFrame {
    /// X' W X.
    pub gram: DMatrix<f64>,
    /// X' W y.
    pub right: DVector<f64>,
}

/// A fit of some columns.
#[derive(Clone, Debug)]
pub struct LinearFit {
    /// Which columns.
    pub columns: Vec<usize>,
    /// Their coefficients.
    pub theta: DVector<f64>,
    /// Covariance; each variance is the larger of that from the noise and that from the scatter of the blocks
    /// (sandwich estimate).
    pub covariance: DMatrix<f64>,
}

/// Fits `columns` on frames; `precision` holds the prior precision of every column (0 for none), `blocks` the block
/// of each frame.
pub fn fit(frames: &[&LinearFrame], blocks: &[usize], columns: &[usize], precision: &[f64]) -> LinearFit {
    let k = columns.len();
    let part = |f: &LinearFrame| {
        let gram = DMatrix::from_fn(k, k, |i, j| f.gram[(columns[i], columns[j])]);
        let right = DVector::from_fn(k, |i, _| f.right[columns[i]]);
        (gram, right)
    };
    let parts: Vec<_> = frames.iter().map(|f| part(f)).collect();
    let mut gram = DMatrix::from_fn(k, k, |i, j| if i == j { precision[columns[i]].max(1e-12) } else { 0.0 });
    let mut right = DVector::zeros(k);
    for (g, r) in &parts {
        gram += g;
        right += r;
    }
    let inverse = gram.clone().try_inverse().unwrap_or_else(|| DMatrix::zeros(k, k));
    let theta = &inverse * &right;
    let mut scatter = DMatrix::zeros(k, k);
    let mut n = 0.0f64;
    let mut i = 0;
    while i < parts.len() {
        let mut score = DVector::zeros(k);
        let block = blocks[i];
        while i < parts.len() && blocks[i] == block {
            score += &parts[i].1 - &parts[i].0 * &theta;
            i += 1;
        }
        scatter += &score * score.transpose();
        n += 1.0;
    }
    let sandwich = &inverse * scatter * &inverse * (n / (n - 1.0).max(1.0));
    LinearFit { columns: columns.to_vec(), theta, covariance: at_least(inverse, &sandwich) }
}

/// A covariance with every variance at least that of another one.
pub fn at_least(mut covariance: DMatrix<f64>, other: &DMatrix<f64>) -> DMatrix<f64> {
    let k = covariance.nrows();
    for i in 0..k {
        let grow = (other[(i, i)] / covariance[(i, i)].max(1e-300)).max(1.0).sqrt();
        for j in 0..k {
            covariance[(i, j)] *= grow;
            covariance[(j, i)] *= grow;
        }
    }
    covariance
}

impl LinearFit {
    /// Gain of a frame over zero coefficients, nats.
    pub fn gain(&self, frame: &LinearFrame) -> f64 {
        gain(frame, &self.columns, self.theta.as_slice())
    }

    /// Standard error of a coefficient.
    pub fn error(&self, i: usize) -> f64 {
        self.covariance[(i, i)].sqrt()
    }
}

/// Gain of a frame by coefficients of some columns over zero ones, nats.
fn gain(frame: &LinearFrame, columns: &[usize], theta: &[f64]) -> f64 {
    let mut gain = 0.0;
    for (i, &a) in columns.iter().enumerate() {
        gain += theta[i] * frame.right[a];
        for (j, &b) in columns.iter().enumerate() {
            gain -= 0.5 * theta[i] * theta[j] * frame.gram[(a, b)];
        }
    }
    gain
}

/// Rounds of [`positive_fit`] over the columns.
const ROUNDS: usize = 2000;

/// Coefficients of some columns of which none is negative, fitted on frames: one column after the other, until none
/// changes.
pub fn positive_fit(frames: &[&LinearFrame], columns: &[usize]) -> Vec<f64> {
    let sum = |i: usize, j: usize| frames.iter().map(|f| f.gram[(columns[i], columns[j])]).sum::<f64>();
    let gram = DMatrix::from_fn(columns.len(), columns.len(), sum);
    let right = DVector::from_fn(columns.len(), |i, _| frames.iter().map(|f| f.right[columns[i]]).sum::<f64>());
    let mut theta = DVector::<f64>::zeros(columns.len());
    for _ in 0..ROUNDS {
        let mut change = 0.0f64;
        for k in 0..columns.len() {
            let scale = gram[(k, k)].max(1e-300);
            let free = theta[k] + (right[k] - gram.row(k).transpose().dot(&theta)) / scale;
            change = change.max((free.max(0.0) - theta[k]).powi(2) * scale);
            theta[k] = free.max(0.0);
        }
        if change < 1e-9 {
            break;
        }
    }
    theta.as_slice().to_vec()
}

/// Gains of each frame when coefficients that are not negative are fitted on the blocks of other folds.
pub fn positive_cross_gains(frames: &[&LinearFrame], blocks: &[usize], columns: &[usize]) -> Vec<f64> {
    let fit_on = |train: &[usize]| positive_fit(&train.iter().map(|&i| frames[i]).collect::<Vec<_>>(), columns);
    cross_validated(blocks, fit_on, |theta, i| gain(frames[i], columns, theta))
}

/// Gains of each frame when the columns are fitted on the blocks of other folds.
pub fn cross_gains(frames: &[&LinearFrame], blocks: &[usize], columns: &[usize], precision: &[f64]) -> Vec<f64> {
    let fit_on = |train: &[usize]| {
        let (train, train_blocks): (Vec<_>, Vec<_>) = train.iter().map(|&i| (frames[i], blocks[i])).unzip();
        (!train.is_empty()).then(|| fit(&train, &train_blocks, columns, precision))
    };
    cross_validated(blocks, fit_on, |fit, i| fit.as_ref().map_or(0.0, |fit| fit.gain(frames[i])))
}

/// What each frame is expected to gain by the columns `with` over the columns `before`, among them, if it is as the
/// blocks of other folds say, nats: half of the square of what the fits differ by.
pub fn cross_expected(
    frames: &[&LinearFrame],
    blocks: &[usize],
    [before, with]: [&[usize]; 2],
    precision: &[f64],
) -> Vec<f64> {
    let fit_on = |train: &[usize]| {
        let (train, train_blocks): (Vec<_>, Vec<_>) = train.iter().map(|&i| (frames[i], blocks[i])).unzip();
        (!train.is_empty()).then(|| [before, with].map(|columns| fit(&train, &train_blocks, columns, precision)))
    };
    let expected = |[before, with]: &[LinearFit; 2], frame: &LinearFrame| {
        let mut by = DVector::zeros(frame.right.len());
        with.columns.iter().zip(with.theta.iter()).for_each(|(c, theta)| by[*c] += theta);
        before.columns.iter().zip(before.theta.iter()).for_each(|(c, theta)| by[*c] -= theta);
        0.5 * by.dot(&(&frame.gram * &by))
    };
    cross_validated(blocks, fit_on, |fits, i| fits.as_ref().map_or(0.0, |fits| expected(fits, frames[i])))
}

/// Gains of each frame by what is fitted on the blocks of other folds, or what else that says of it; frames are known
/// by their places in `blocks`.
pub fn cross_validated<F, T: Clone + Default>(
    blocks: &[usize],
    fit: impl Fn(&[usize]) -> F,
    gain: impl Fn(&F, usize) -> T,
) -> Vec<T> {
    let folds = fold_of(blocks);
    let mut gains = vec![T::default(); blocks.len()];
    for fold in 0..FOLDS {
        let (test, train): (Vec<usize>, Vec<usize>) = (0..blocks.len()).partition(|&i| folds[i] == fold);
        if test.is_empty() {
            continue;
        }
        let fitted = fit(&train);
        test.into_iter().for_each(|i| gains[i] = gain(&fitted, i));
    }
    gains
}

/// Folds of cross-validation.
pub const FOLDS: usize = 4;

/// Fold of each frame: whole blocks, in turn.
pub fn fold_of(blocks: &[usize]) -> Vec<usize> {
    let mut seen: Vec<usize> = blocks.to_vec();
    seen.dedup();
    blocks.iter().map(|b| seen.iter().position(|s| s == b).unwrap_or(0) % FOLDS).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand_distr::{Distribution, StandardNormal};

    /// Frames of y = theta x + noise with x = (1, u).
    fn made(theta: [f64; 2], frames: usize, seed: u64) -> Vec<LinearFrame> {
        let mut rng = data::stream(seed, "linear", 0, 0);
        (0..frames)
            .map(|_| {
                let (mut gram, mut right) = (DMatrix::zeros(2, 2), DVector::zeros(2));
                for i in 0..50 {
                    let x = DVector::from_vec(vec![1.0, i as f64 / 25.0 - 1.0]);
                    let noise: f64 = StandardNormal.sample(&mut rng);
                    gram += &x * x.transpose();
                    right += &x * (x[0] * theta[0] + x[1] * theta[1] + noise);
                }
                LinearFrame { gram, right }
            })
            .collect()
    }

    #[test]
    fn coefficients_errors_and_gains() {
        let frames = made([0.0, 0.5], 24, 1);
        let refs: Vec<_> = frames.iter().collect();
        let blocks: Vec<usize> = (0..24).map(|i| i / 2).collect();
        let fitted = fit(&refs, &blocks, &[0, 1], &[0.0, 0.0]);
        assert!((fitted.theta[1] - 0.5).abs() < 3.5 * fitted.error(1) && fitted.error(1) < 0.1);
        assert!(fitted.theta[0].abs() < 3.5 * fitted.error(0));
        let gain: f64 = cross_gains(&refs, &blocks, &[1], &[0.0, 0.0]).iter().sum();
        let none: f64 = cross_gains(&refs, &blocks, &[0], &[0.0, 0.0]).iter().sum();
        // A gain by chance is below what a choice demands.
        assert!(gain > 20.0 && none < 8.0, "{gain} {none}");
    }

    #[test]
    fn no_coefficient_of_a_positive_fit_is_negative() {
        let frames = made([-0.3, 0.5], 24, 2);
        let refs: Vec<_> = frames.iter().collect();
        let blocks: Vec<usize> = (0..24).map(|i| i / 2).collect();
        let theta = positive_fit(&refs, &[0, 1]);
        let alone = fit(&refs, &blocks, &[1], &[0.0, 0.0]);
        assert!(theta[0] == 0.0 && (theta[1] - alone.theta[0]).abs() < 1e-6, "{theta:?}");
        let both = positive_fit(&made([0.3, 0.5], 24, 3).iter().collect::<Vec<_>>(), &[0, 1]);
        assert!((both[0] - 0.3).abs() < 0.1 && (both[1] - 0.5).abs() < 0.15, "{both:?}");
        let gains: f64 = positive_cross_gains(&refs, &blocks, &[0, 1]).iter().sum();
        let free: f64 = cross_gains(&refs, &blocks, &[1], &[0.0, 0.0]).iter().sum();
        assert!((gains - free).abs() < 1e-3, "{gains} {free}");
    }
}
