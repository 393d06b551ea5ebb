//! Precision-recall curves and the average precisions computed from them.

use crate::matching::Counts;

/// Recall positions of the KITTI curve.
const POINTS: usize = 41;

/// Counts as the score threshold falls.
pub(crate) struct CountsByScore {
    /// Each distinct score at which the counts change, descending, with the counts of all detections of at least that
    /// score.
    points: Vec<(f64, Counts)>,
    nothing: Counts,
}

impl CountsByScore {
    /// From the count changes of single frames per score, in any order. Starts with all `n_gt` ground truths missed.
    pub(crate) fn new(mut changes: Vec<(f64, Counts)>, n_gt: i64) -> Self {
        changes.sort_by(|a, b| b.0.total_cmp(&a.0)); // stable, so equal scores keep the frame order
        let nothing = Counts { fn_: n_gt, ..Counts::default() };
        let mut points: Vec<(f64, Counts)> = Vec::new();
        let mut now = nothing;
        for (score, change) in changes {
            now += change;
            match points.last_mut() {
                Some(last) if last.0 == score => last.1 = now,
                _ => points.push((score, now)),
            }
        }
        CountsByScore { points, nothing }
    }

    /// Counts of the detections with at least this score.
    fn at(&self, least_score: f64) -> Counts {
        match self.points.partition_point(|(score, _)| *score >= least_score) {
            0 => self.nothing,
            n => self.points[n - 1].1,
        }
    }

    /// Counts of all detections.
    pub(crate) fn all(&self) -> Counts {
        self.points.last().map_or(self.nothing, |(_, counts)| *counts)
    }

    /// Area under precision (or orientation similarity if `similarity`) over recall, percent, with a point at every
    /// distinct score and precision interpolated as the maximum at equal or higher recall. Points with 0/0 are
    /// skipped. 0 without ground truth.
    pub(crate) fn exact_area(&self, n_gt: i64, similarity: bool) -> f64 {
        let point = |(_, c): &(f64, Counts)| (c.tp, share(c, similarity));
        let mut points: Vec<(i64, f64)> = self.points.iter().map(point).filter(|(_, p)| !p.is_nan()).collect();
        points.sort_by_key(|(tp, _)| *tp);
        let (mut area, mut highest) = (0.0, 0.0f64);
        for (i, (tp, precision)) in points.iter().enumerate().rev() {
            highest = highest.max(*precision);
            let before = if i == 0 { 0 } else { points[i - 1].0 };
            area += (tp - before) as f64 * highest;
        }
        if n_gt == 0 { 0.0 } else { 100.0 * area / n_gt as f64 }
    }
}

/// Precision, or orientation similarity divided by the number of detections; NaN for 0/0.
fn share(c: &Counts, similarity: bool) -> f64 {
    let part = if similarity { c.similarity } else { c.tp as f64 };
    part / (c.tp + c.fp) as f64
}

/// KITTI's precision-recall curve with 41 points.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct PrecisionCurve {
    /// Score thresholds, descending, at most 41.
    pub thresholds: Vec<f64>,
    /// Counts of the detections with at least each threshold.
    pub counts: Vec<Counts>,
    /// 41 values: precision (orientation similarity for AOS) after the running maximum from the right; 0 for recalls
    /// that no threshold reaches, NaN where the running maximum includes 0/0.
    pub precision: Vec<f64>,
}

impl PrecisionCurve {
    /// From the true-positive scores of the first pass and the counts of the second.
    pub(crate) fn new(hit_scores: &[f64], n_gt: i64, counts: &CountsByScore, similarity: bool) -> Self {
        let thresholds = score_thresholds(hit_scores, n_gt);
        let counts: Vec<Counts> = thresholds.iter().map(|t| counts.at(*t)).collect();
        let mut precision = vec![0.0; POINTS];
        let mut highest = 0.0f64;
        for (i, c) in counts.iter().enumerate().rev() {
            let here = share(c, similarity);
            highest = if here.is_nan() || highest.is_nan() { f64::NAN } else { highest.max(here) };
            precision[i] = highest;
        }
        PrecisionCurve { thresholds, counts, precision }
    }

    /// Mean of the points 0, 4, ..., 40, percent; `None` if one of them is 0/0.
    pub fn ap11(&self) -> Option<f64> {
        mean_percent(self.precision.iter().step_by(4), 11.0)
    }

    /// Mean of the points 1 to 40, percent; `None` if one of them is 0/0.
    pub fn ap40(&self) -> Option<f64> {
        mean_percent(self.precision.iter().skip(1), 40.0)
    }

    /// Number of curve points with neither true nor false positives.
    pub fn undefined_points(&self) -> usize {
        self.counts.iter().filter(|c| c.tp + c.fp == 0).count()
    }
}

fn mean_percent<'a>(values: impl Iterator<Item = &'a f64>, n: f64) -> Option<f64> {
    Some(values.sum::<f64>() / n * 100.0).filter(|mean| !mean.is_nan())
}

/// Score thresholds closest to the recalls 0, 1/40, ..., 1. The lowest-scoring true positive always adds one.
fn score_thresholds(hit_scores: &[f64], n_gt: i64) -> Vec<f64> {
    let mut scores = hit_scores.to_vec();
    scores.sort_by(|a, b| b.total_cmp(a));
    let (mut thresholds, mut recall) = (Vec::new(), 0.0);
    for (i, score) in scores.iter().enumerate() {
        let last = i + 1 == scores.len();
        let left = (i + 1) as f64 / n_gt as f64;
        let right = if last { left } else { (i + 2) as f64 / n_gt as f64 };
        if right - recall < recall - left && !last {
            continue;
        }
        thresholds.push(*score);
        recall += 1.0 / (POINTS - 1) as f64;
    }
    thresholds.truncate(POINTS);
    thresholds
}

/// Upper bound of AP40 with `n_gt` ground truths, percent: (n - 1) / 40, since each true positive yields one curve
/// point and the first point is not averaged. `None` without ground truth.
pub fn ceiling_ap40(n_gt: i64) -> Option<f64> {
    (n_gt > 0).then(|| (n_gt - 1).min(40) as f64 / 40.0 * 100.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_perfect_detector_reaches_the_ceiling() {
        for n in [1, 2, 10, 20, 39, 40, 41, 42, 100, 1000] {
            let scores: Vec<f64> = (0..n).map(|i| f64::from(i) / 1000.0).collect();
            let hit = Counts { tp: 1, fn_: -1, similarity: 1.0, ..Counts::default() };
            let n = i64::from(n);
            let counts = CountsByScore::new(scores.iter().map(|s| (*s, hit)).collect(), n);
            let curve = PrecisionCurve::new(&scores, n, &counts, false);
            assert!((curve.ap40().unwrap() - ceiling_ap40(n).unwrap()).abs() < 1e-9, "{n}");
            assert!((counts.exact_area(n, false) - 100.0).abs() < 1e-9, "{n}");
            assert_eq!(counts.all().fn_, 0);
        }
    }

    #[test]
    fn equal_scores_are_one_point() {
        let (hit, alarm) = (Counts { tp: 1, ..Counts::default() }, Counts { fp: 1, ..Counts::default() });
        let mut changes = vec![(0.5, hit); 30];
        changes.extend(vec![(0.5, alarm); 21]);
        let counts = CountsByScore::new(changes, 30);
        assert!((counts.exact_area(30, false) - 100.0 * 30.0 / 51.0).abs() < 1e-12);
    }
}
