//! The second pass of the matching at every score, from the highest down, computed by what changes.
//!
//! Ground truths choose in their order, each the detection that it prefers among the free ones. A lower score adds a
//! detection. The first ground truth that prefers it takes it and frees its own, which a later one may prefer in turn.
//! All others keep what they have. For `n` labels and `m` detections that all overlap this takes `n m` steps; a new
//! count at every score would take `n m m`.

use super::{Counts, FrameMatching, Role};

/// A detection as a ground truth sees it.
#[derive(Clone, Copy)]
struct Choice {
    detection: usize,
    /// 0 for an ignored detection: any counted one is better.
    overlap: f64,
}

impl Choice {
    fn is_better_than(&self, other: &Choice) -> bool {
        self.overlap > other.overlap || (self.overlap == other.overlap && self.detection < other.detection)
    }
}

/// A matching whose score limit falls.
pub(super) struct Falling<'a, 'f> {
    matching: &'a FrameMatching<'f>,
    /// Labels with sufficient overlap and their overlaps: those of detection `j` at `starts[j]..starts[j + 1]`.
    labels: Vec<(u32, f64)>,
    starts: Vec<usize>,
    /// By label.
    choices: Vec<Option<Choice>>,
    /// By label: similarity of a true positive, else 0.
    similarities: Vec<f64>,
    /// Whether an unmatched detection is a false positive.
    alarms: Vec<bool>,
    counts: Counts,
}

impl<'a, 'f> Falling<'a, 'f> {
    /// The matching without detections.
    pub(super) fn new(matching: &'a FrameMatching<'f>) -> Self {
        let (labels, starts) = labels_by_detection(matching);
        let counted = |j: usize| matching.detections[j] == Role::Counted && !matching.spared[j];
        let mut alarms: Vec<bool> = (0..matching.detections.len()).map(counted).collect();
        for pair in matching.dont_care.iter().filter(|pair| pair.overlap > matching.min_overlap) {
            alarms[pair.detection] = false;
        }
        Falling {
            matching,
            labels,
            starts,
            choices: vec![None; matching.labels.len()],
            similarities: vec![0.0; matching.labels.len()],
            alarms,
            counts: Counts { fn_: matching.n_gt(), ..Counts::default() },
        }
    }

    /// Counts with the detections that were added.
    pub(super) fn counts(&self) -> Counts {
        // In the order of the labels, so that rounding does not depend on what was added before.
        Counts { similarity: self.similarities.iter().fold(0.0, |sum, s| sum + s), ..self.counts }
    }

    /// Adds a detection.
    pub(super) fn add(&mut self, detection: usize) {
        let (mut free, mut from) = (detection, 0);
        while let Some((label, choice)) = self.taker(free, from) {
            let before = self.choices[label].replace(choice);
            self.count(label, before, choice.detection);
            match before {
                Some(other) => (free, from) = (other.detection, label + 1),
                None => return,
            }
        }
        self.counts.fp += i64::from(self.alarms[free]);
    }

    /// The first label from `from` on that prefers a detection to its own.
    fn taker(&self, detection: usize, from: usize) -> Option<(usize, Choice)> {
        let near = &self.labels[self.starts[detection]..self.starts[detection + 1]];
        let counted = self.matching.detections[detection] == Role::Counted;
        near[near.partition_point(|(label, _)| (*label as usize) < from)..].iter().find_map(|(label, overlap)| {
            let label = *label as usize;
            let choice = Choice { detection, overlap: if counted { *overlap } else { 0.0 } };
            self.choices[label].is_none_or(|own| choice.is_better_than(&own)).then_some((label, choice))
        })
    }

    /// Counts a label that has taken another detection.
    fn count(&mut self, label: usize, before: Option<Choice>, now: usize) {
        if self.matching.labels[label] != Role::Counted {
            return;
        }
        let is_hit = |j: usize| self.matching.detections[j] == Role::Counted;
        self.counts.fn_ -= i64::from(before.is_none());
        self.counts.tp += i64::from(is_hit(now)) - i64::from(before.is_some_and(|b| is_hit(b.detection)));
        self.similarities[label] = if is_hit(now) { self.matching.similarity(label, now) } else { 0.0 };
    }
}

/// Labels and overlaps of each detection, in the order of the labels, and where those of each detection begin.
fn labels_by_detection(matching: &FrameMatching) -> (Vec<(u32, f64)>, Vec<usize>) {
    let take_part = || {
        matching.pairs.iter().filter(|pair| {
            pair.overlap > matching.min_overlap
                && matching.labels[pair.label] != Role::Absent
                && matching.detections[pair.detection] != Role::Absent
        })
    };
    let mut starts = vec![0; matching.detections.len() + 1];
    take_part().for_each(|pair| starts[pair.detection + 1] += 1);
    (1..starts.len()).for_each(|j| starts[j] += starts[j - 1]);
    let mut next = starts.clone();
    let mut labels = vec![(0, 0.0); starts[starts.len() - 1]];
    for pair in take_part() {
        labels[next[pair.detection]] = (pair.label as u32, pair.overlap);
        next[pair.detection] += 1;
    }
    (labels, starts)
}

#[cfg(test)]
mod tests {
    use crate::matching::{BoxIndex, CurveKey, FrameMatching};
    use crate::overlaps::FrameOverlaps;
    use crate::{Difficulty, EvalFrame, Metric};
    use data::{LabelBox, LabelFrame, stream};
    use proptest::prelude::*;
    use rand::RngExt;

    /// Crowded boxes of several classes and heights, with few distinct scores and places.
    fn crowd(seed: u64) -> EvalFrame {
        let mut rng = stream(seed, "falling test", 0, 0);
        let mut line = |score: bool| {
            let x = f64::from(rng.random_range(0..12u8)) * 0.7;
            let bbox = geometry::Box3::from_array([x, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0]);
            let class = ["Car", "Car", "Car", "Van", "DontCare"][rng.random_range(0..if score { 4 } else { 5 })];
            let mut line = LabelBox::from_box(class, &bbox, score.then(|| rng.random_range(0..5u8).into()));
            let low = rng.random_range(0..4u8) == 0;
            line.image_box = [10.0 * x, 100.0, 10.0 * x + 60.0, if low { 120.0 } else { 160.0 }];
            (line.truncation, line.occlusion) = (0.0, 0.0);
            line.alpha = rng.random_range(-3.0..3.0);
            line
        };
        let labels = (0..14).map(|_| line(false)).collect();
        EvalFrame { id: "a".into(), labels, detections: (0..20).map(|_| line(true)).collect() }
    }

    proptest! {
        #[test]
        fn a_falling_limit_counts_as_each_limit_alone(seed in 0u64..100_000) {
            let frame = crowd(seed);
            let overlaps = FrameOverlaps::new(&frame, LabelFrame::Lidar);
            for metric in [Metric::Bbox, Metric::ThreeD] {
                for difficulty in Difficulty::ALL {
                    let key = CurveKey { class: "Car", metric, overlap: 0.3, difficulty };
                    let inside = |index: BoxIndex| !matches!(index, BoxIndex::Label(1) | BoxIndex::Detection(3));
                    let mut matching = FrameMatching::new((&frame, &overlaps), &key, inside);
                    let mut want = Vec::new();
                    let mut before = matching.count(f64::INFINITY);
                    for score in matching.distinct_scores() {
                        let now = matching.count(score);
                        if now != before {
                            want.push((score, now - before));
                            before = now;
                        }
                    }
                    prop_assert_eq!(matching.changes(), want);
                }
            }
        }
    }
}
