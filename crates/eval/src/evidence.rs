//! Contributions of single frames to a curve, kept separately so that frames can be resampled.

use crate::EvalFrame;
use crate::matching::{BoxIndex, Counts, CurveKey, FrameMatching};
use crate::overlaps::FrameOverlaps;

/// Contribution of one frame to one curve.
pub(crate) struct FrameEvidence {
    /// Ground truths that count.
    pub n_gt: i64,
    /// Scores of the true positives of the first pass.
    pub hit_scores: Vec<f64>,
    /// Scores at which the counts of the second pass change, descending, with the change.
    pub changes: Vec<(f64, Counts)>,
}

impl FrameEvidence {
    /// `inside` selects the boxes that are evaluated; see [`FrameMatching::new`].
    pub(crate) fn collect(
        frame: (&EvalFrame, &FrameOverlaps),
        key: &CurveKey,
        inside: impl Fn(BoxIndex) -> bool,
    ) -> Self {
        let mut matching = FrameMatching::new(frame, key, inside);
        let mut hit_scores = Vec::new();
        matching.collect_hit_scores(&mut hit_scores);
        FrameEvidence { n_gt: matching.n_gt(), hit_scores, changes: matching.changes() }
    }
}

/// Contributions of all frames of a run to one curve, sorted once by descending score.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Evidence {
    /// Ground truths per frame.
    n_gt: Vec<u32>,
    /// Score and frame of each true positive of the first pass.
    hits: Vec<(f64, u32)>,
    /// Score, frame, and the change in true and false positives.
    changes: Vec<(f64, u32, i32, i32)>,
}

/// Average precisions and the underlying counts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Precisions {
    /// Percent; NaN if precision is 0/0 at a threshold.
    pub ap40: f64,
    /// Percent.
    pub ap_area: f64,
    pub n_gt: i64,
    pub n_tp: i64,
    pub n_fp: i64,
}

impl Evidence {
    pub(crate) fn new(frames: impl Iterator<Item = FrameEvidence>) -> Self {
        let mut out = Evidence::default();
        for (i, frame) in frames.enumerate() {
            let i = i as u32;
            out.n_gt.push(frame.n_gt as u32);
            out.hits.extend(frame.hit_scores.into_iter().map(|score| (score, i)));
            let change = |(score, c): (f64, Counts)| (score, i, c.tp as i32, c.fp as i32);
            out.changes.extend(frame.changes.into_iter().map(change));
        }
        out.hits.sort_by(|a, b| b.0.total_cmp(&a.0)); // stable: equal scores keep the frame order
        out.changes.sort_by(|a, b| b.0.total_cmp(&a.0));
        out
    }

    /// Precisions with frame `i` repeated `weights[i]` times; without weights, once each.
    pub(crate) fn precisions(&self, weights: Option<&[u32]>) -> Precisions {
        let weight = |frame: u32| weights.map_or(1, |w| i64::from(w[frame as usize]));
        let n_gt: i64 = self.n_gt.iter().enumerate().map(|(i, n)| i64::from(*n) * weight(i as u32)).sum();
        let ap40 = self.ap40(n_gt, weight);
        let (ap_area, n_tp, n_fp) = self.exact_area(n_gt, weight);
        Precisions { ap40, ap_area, n_gt, n_tp, n_fp }
    }

    /// KITTI's curve as in [`crate::curve`], with repeated frames.
    fn ap40(&self, n_gt: i64, weight: impl Fn(u32) -> i64) -> f64 {
        const POINTS: usize = 41;
        let n_hits: i64 = self.hits.iter().map(|(_, frame)| weight(*frame)).sum();
        let mut precision = [0.0f64; POINTS];
        let (mut seen, mut points, mut recall) = (0, 0, 0.0);
        let (mut tp, mut fp, mut changes) = (0, 0, self.changes.iter().peekable());
        'hits: for (score, frame) in &self.hits {
            for _ in 0..weight(*frame) {
                seen += 1;
                let last = seen == n_hits;
                let left = seen as f64 / n_gt as f64;
                let right = if last { left } else { (seen + 1) as f64 / n_gt as f64 };
                if right - recall < recall - left && !last {
                    continue;
                }
                while let Some((_, frame, more_tp, more_fp)) = changes.next_if(|change| change.0 >= *score) {
                    tp += weight(*frame) * i64::from(*more_tp);
                    fp += weight(*frame) * i64::from(*more_fp);
                }
                precision[points] = tp as f64 / (tp + fp) as f64; // NaN for 0/0
                points += 1;
                recall += 1.0 / (POINTS - 1) as f64;
                if points == POINTS {
                    break 'hits;
                }
            }
        }
        let (mut highest, mut sum) = (0.0f64, 0.0);
        for i in (1..POINTS).rev() {
            highest = if precision[i].is_nan() || highest.is_nan() { f64::NAN } else { highest.max(precision[i]) };
            sum += highest;
        }
        sum / (POINTS - 1) as f64 * 100.0
    }

    /// As `CountsByScore::exact_area`, with repeated frames; also returns all true and false positives.
    fn exact_area(&self, n_gt: i64, weight: impl Fn(u32) -> i64) -> (f64, i64, i64) {
        let mut points: Vec<(i64, f64)> = Vec::new();
        let (mut tp, mut fp) = (0, 0);
        for (i, (score, frame, more_tp, more_fp)) in self.changes.iter().enumerate() {
            let n = weight(*frame);
            (tp, fp) = (tp + n * i64::from(*more_tp), fp + n * i64::from(*more_fp));
            let last_of_score = self.changes.get(i + 1).is_none_or(|next| next.0 != *score);
            if last_of_score && tp + fp > 0 {
                points.push((tp, tp as f64 / (tp + fp) as f64));
            }
        }
        if n_gt == 0 {
            return (0.0, tp, fp);
        }
        if !points.is_sorted_by_key(|(tp, _)| *tp) {
            // A lower threshold can remove a true positive: its ground truth may take an ignored detection.
            points.sort_by_key(|(tp, _)| *tp);
        }
        let (mut area, mut highest) = (0.0, 0.0f64);
        for (i, (tp, precision)) in points.iter().enumerate().rev() {
            highest = highest.max(*precision);
            let before = if i == 0 { 0 } else { points[i - 1].0 };
            area += (tp - before) as f64 * highest;
        }
        (100.0 * area / n_gt as f64, tp, fp)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Difficulty, Metric};
    use data::{LabelBox, LabelFrame, stream};
    use proptest::prelude::*;
    use rand::RngExt;

    /// Frames with up to three cars, detected or not, with many equal scores.
    fn frames(seed: u64) -> Vec<EvalFrame> {
        let mut rng = stream(seed, "evidence test", 0, 0);
        let mut car = |x: f64, score: bool| {
            let bbox = geometry::Box3::from_array([x, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0]);
            let score = score.then(|| rng.random_range(0..8) as f32 / 8.0);
            (LabelBox::from_box("Car", &bbox, score), rng.random_range(0.0..1.0))
        };
        (0..12)
            .map(|i| {
                let mut frame = EvalFrame { id: i.to_string(), labels: vec![], detections: vec![] };
                for k in 0..3 {
                    let x = 10.0 * f64::from(k);
                    let (label, chance): (LabelBox, f64) = car(x, false);
                    if chance < 0.7 {
                        frame.labels.push(label);
                    }
                    for dx in [0.2, 0.9, 2.5] {
                        let (found, chance) = car(x + dx, true);
                        if chance < 0.5 {
                            frame.detections.push(found);
                        }
                    }
                }
                frame
            })
            .collect()
    }

    fn evidence(frames: &[EvalFrame]) -> Evidence {
        let key = CurveKey { class: "Car", metric: Metric::ThreeD, overlap: 0.5, difficulty: Difficulty::All };
        let inside = |index: BoxIndex| index != BoxIndex::Label(1) && index != BoxIndex::Detection(0);
        Evidence::new(
            frames.iter().map(|frame| {
                FrameEvidence::collect((frame, &FrameOverlaps::new(frame, LabelFrame::Lidar)), &key, inside)
            }),
        )
    }

    proptest! {
        #[test]
        fn a_weight_is_a_repetition(seed in 0u64..1000, weights in proptest::collection::vec(0u32..4, 12)) {
            let frames = frames(seed);
            let repeated: Vec<EvalFrame> =
                frames.iter().zip(&weights).flat_map(|(frame, n)| std::iter::repeat_n(frame.clone(), *n as usize)).collect();
            let (got, want) = (evidence(&frames).precisions(Some(&weights)), evidence(&repeated).precisions(None));
            prop_assert_eq!((got.n_gt, got.n_tp, got.n_fp), (want.n_gt, want.n_tp, want.n_fp));
            let near = |a: f64, b: f64| (a.is_nan() && b.is_nan()) || (a - b).abs() < 1e-9;
            prop_assert!(near(got.ap40, want.ap40) && near(got.ap_area, want.ap_area), "{:?} {:?}", got, want);
        }
    }
}
