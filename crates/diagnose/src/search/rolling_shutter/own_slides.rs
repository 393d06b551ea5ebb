//! Displacements of single frames where the ego speed is not known: it changes from frame to frame, and with it how far
//! the scene slides.

/// Displacements of the frames over a scan, m: normal about a mean.
pub(super) struct OwnSlides {
    pub(super) mean: f64,
    /// Standard error of the mean.
    pub(super) error: f64,
    /// Standard deviation from frame to frame.
    pub(super) spread: f64,
}

/// Iterations of the fit.
const ITERATIONS: usize = 100;

/// Standard deviation from frame to frame at which the fit starts, as a share of the mean: that of speeds.
const START: f64 = 0.3;

impl OwnSlides {
    /// Fits mean and spread by expectation maximisation, from a mean on. `frames` has the log likelihood of every frame
    /// by displacement, on the grid `at`; `blocks` says which frames belong together.
    pub(super) fn fit(at: &[f64], frames: &[&[f64]], blocks: &[Vec<usize>], from: f64) -> OwnSlides {
        let step = at.windows(2).map(|w| w[1] - w[0]).fold(f64::INFINITY, f64::min);
        let n = frames.len().max(1) as f64;
        let mut own = OwnSlides { mean: from, error: 0.0, spread: START * from.abs() };
        for _ in 0..ITERATIONS {
            let of_frames: Vec<[f64; 2]> = frames.iter().map(|frame| own.of_frame(at, frame)).collect();
            own.mean = of_frames.iter().map(|[mean, _]| mean).sum::<f64>() / n;
            let square = of_frames.iter().map(|[mean, variance]| variance + (mean - own.mean).powi(2)).sum::<f64>() / n;
            own.spread = square.sqrt().max(step / 2.0);
        }
        // Standard error from the scatter of the scores of blocks, by the observed information (Louis 1982).
        let variance = own.spread * own.spread;
        let of_frames: Vec<[f64; 2]> = frames.iter().map(|frame| own.of_frame(at, frame)).collect();
        let score = |&f: &usize| (of_frames[f][0] - own.mean) / variance;
        let scores: f64 = blocks.iter().map(|block| block.iter().map(score).sum::<f64>().powi(2)).sum();
        let information: f64 = of_frames.iter().map(|[_, own]| (1.0 - own / variance) / variance).sum();
        own.error = if information > 0.0 { scores.sqrt() / information } else { f64::INFINITY };
        own
    }

    /// Mean and variance of the displacement of a frame by its log likelihood and that of the others.
    pub(super) fn of_frame(&self, at: &[f64], log_likelihood: &[f64]) -> [f64; 2] {
        let prior = |s: f64| -0.5 * ((s - self.mean) / self.spread).powi(2);
        let logs: Vec<f64> = at.iter().zip(log_likelihood).map(|(s, l)| l + prior(*s)).collect();
        let top = logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let weights: Vec<f64> = logs.iter().map(|l| (l - top).exp()).collect();
        let total: f64 = weights.iter().sum();
        let moment = |of: &dyn Fn(f64) -> f64| at.iter().zip(&weights).map(|(s, w)| w * of(*s)).sum::<f64>() / total;
        let mean = moment(&|s| s);
        [mean, moment(&|s| (s - mean).powi(2))]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand_distr::{Distribution, StandardNormal};

    /// Frames with displacements about 2.2 m, measured with an error of 0.4 m; every third one tells nothing.
    fn fitted(spread: f64, seed: u64) -> (OwnSlides, Vec<f64>, Vec<f64>) {
        let at: Vec<f64> = (-70..=70).map(|k| 0.1 * f64::from(k)).collect();
        let mut rng = data::stream(seed, "own slides", 0, 0);
        let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
        let truth: Vec<f64> = (0..90).map(|_| 2.2 + spread * normal()).collect();
        let log_likelihood = |(f, truth): (usize, &f64)| {
            let seen = truth + 0.4 * normal();
            let tells = if f % 3 == 2 { 0.0 } else { 1.0 };
            at.iter().map(|s| -0.5 * tells * ((s - seen) / 0.4).powi(2)).collect()
        };
        let frames: Vec<Vec<f64>> = truth.iter().enumerate().map(log_likelihood).collect();
        let blocks: Vec<Vec<usize>> = (0..90).map(|f| vec![f]).collect();
        let own = OwnSlides::fit(&at, &frames.iter().map(|f| &f[..]).collect::<Vec<_>>(), &blocks, 3.0);
        let of_frames = frames.iter().map(|frame| own.of_frame(&at, frame)[0]).collect();
        (own, truth, of_frames)
    }

    #[test]
    fn mean_spread_and_the_slide_of_each_frame_are_found() {
        for spread in [0.0, 0.6] {
            let mut inside = 0;
            for seed in 0..20 {
                let (own, truth, of_frames) = fitted(spread, seed);
                inside += u32::from((own.mean - 2.2).abs() < 2.0 * own.error);
                assert!((own.spread - spread).abs() < 0.25, "{} {spread}", own.spread);
                assert!(own.error > 0.02 && own.error < 0.15, "{}", own.error);
                let off = |frames: &[f64]| frames.iter().zip(&truth).map(|(a, b)| (a - b).powi(2)).sum::<f64>();
                assert!(spread == 0.0 || off(&of_frames) < 0.8 * off(&[own.mean; 90]));
            }
            assert!(inside >= 17, "{inside} of 20 intervals of two standard errors");
        }
    }
}
