//! Score calibration: precision of the detections as a function of their score.

use super::AnalysisOptions;
use super::strata::near;
use crate::matching::{CurveKey, FrameMatching};
use crate::overlaps::FrameOverlaps;
use crate::{Difficulty, EvalFrame, Metric};
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A bin of detections with similar scores.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ScoreBin {
    /// Lowest score in the bin.
    pub from: f64,
    /// Highest score, exclusive; the last bin includes 1.
    pub to: f64,
    /// Detections that are a true or false positive.
    pub n: usize,
    /// Mean score; `None` if the bin is empty.
    pub mean_score: Option<f64>,
    /// Fraction of true positives; `None` if the bin is empty.
    pub precision: Option<f64>,
}

/// Calibration of the detection scores as probabilities.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Calibration {
    /// Ten bins of equal width.
    pub bins: Vec<ScoreBin>,
    /// Expected calibration error: mean of |score - precision| over the bins, weighted by the number of detections;
    /// `None` without detections.
    pub expected_error: Option<f64>,
    /// Detections whose score is outside [0, 1]; they are in no bin.
    pub n_outside: usize,
}

/// Precision per score bin over all detections, with KITTI's matching and no difficulty filter.
pub fn calibration(frames: &[EvalFrame], options: &AnalysisOptions) -> Calibration {
    let key = CurveKey {
        class: &options.class,
        metric: Metric::ThreeD,
        overlap: options.overlap,
        difficulty: Difficulty::All,
    };
    let of_frame = |frame: &EvalFrame| -> Vec<(f64, bool)> {
        let overlaps = FrameOverlaps::new(frame, options.label_frame);
        let outcomes = FrameMatching::new((frame, &overlaps), &key, |index| near(frame, index, options)).outcomes();
        let scores = frame.detections.iter().map(|line| line.score.unwrap_or(0.0));
        scores.zip(outcomes).filter_map(|(score, outcome)| outcome.map(|hit| (score, hit))).collect()
    };
    let all: Vec<(f64, bool)> = frames.par_iter().map(of_frame).collect::<Vec<_>>().into_iter().flatten().collect();
    let inside: Vec<(f64, bool)> = all.iter().copied().filter(|(score, _)| (0.0..=1.0).contains(score)).collect();
    let bins: Vec<ScoreBin> = (0..10)
        .map(|k| {
            let (from, to) = (f64::from(k) / 10.0, f64::from(k + 1) / 10.0);
            let of_bin = inside.iter().filter(|(score, _)| *score >= from && (*score < to || k == 9));
            let of_bin: Vec<(f64, bool)> = of_bin.copied().collect();
            let n = of_bin.len();
            let share = |sum: f64| (n > 0).then(|| sum / n as f64);
            ScoreBin {
                from,
                to,
                n,
                mean_score: share(of_bin.iter().map(|(score, _)| score).sum()),
                precision: share(of_bin.iter().filter(|(_, hit)| *hit).count() as f64),
            }
        })
        .collect();
    let error = |bin: &ScoreBin| Some(bin.n as f64 * (bin.mean_score? - bin.precision?).abs());
    let expected = bins.iter().filter_map(error).sum::<f64>() / inside.len() as f64;
    Calibration { bins, expected_error: (!inside.is_empty()).then_some(expected), n_outside: all.len() - inside.len() }
}
