//! KITTI's assignment of detections to ground truths in one frame, equivalent to OpenPCDet's
//! `kitti_object_eval_python/eval.py`.

mod falling;

use crate::overlaps::{FrameOverlaps, Pair};
use crate::{Difficulty, EvalFrame, Metric};
use data::LabelBox;
use falling::Falling;
use serde::{Deserialize, Serialize};
use std::ops::{AddAssign, Sub};

/// True positives, false positives and false negatives.
#[derive(Clone, Copy, Debug, PartialEq, Default, Serialize, Deserialize)]
pub struct Counts {
    /// True positives.
    pub tp: i64,
    /// False positives.
    pub fp: i64,
    /// False negatives. A ground truth matched by an ignored detection is neither a true positive nor a false
    /// negative.
    pub fn_: i64,
    /// Sum over the true positives of (1 + cos(alpha error)) / 2.
    pub similarity: f64,
}

impl Sub for Counts {
    type Output = Counts;

    fn sub(self, o: Counts) -> Counts {
        Counts {
            tp: self.tp - o.tp,
            fp: self.fp - o.fp,
            fn_: self.fn_ - o.fn_,
            similarity: self.similarity - o.similarity,
        }
    }
}

impl AddAssign for Counts {
    fn add_assign(&mut self, o: Counts) {
        self.tp += o.tp;
        self.fp += o.fp;
        self.fn_ += o.fn_;
        self.similarity += o.similarity;
    }
}

/// How a label or detection is treated for one class and difficulty.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Role {
    /// Counted (KITTI's 0).
    Counted,
    /// Can be matched, but is not counted (KITTI's 1).
    Ignored,
    /// Of another class (KITTI's -1).
    Absent,
}

/// Class, difficulty, metric and overlap limit of a curve.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct CurveKey<'a> {
    pub class: &'a str,
    pub metric: Metric,
    /// Overlap that has to be exceeded.
    pub overlap: f64,
    pub difficulty: Difficulty,
}

/// Index of a label or detection in a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum BoxIndex {
    Label(usize),
    Detection(usize),
}

/// Matching of one frame for one class, difficulty, metric and overlap limit.
pub(crate) struct FrameMatching<'a> {
    frame: &'a EvalFrame,
    labels: Vec<Role>,
    detections: Vec<Role>,
    /// Detections that can match but are no false positive if unmatched: those outside the evaluated region.
    spared: Vec<bool>,
    pairs: &'a [Pair],
    dont_care: &'a [Pair],
    min_overlap: f64,
    taken: Vec<bool>,
    /// Detections that were true positives in the last count.
    hits: Vec<bool>,
}

impl<'a> FrameMatching<'a> {
    /// `inside` selects the boxes that are evaluated. Ground truth outside is ignored, and so are unmatched detections
    /// outside.
    pub(crate) fn new(
        (frame, overlaps): (&'a EvalFrame, &'a FrameOverlaps),
        key: &CurveKey,
        inside: impl Fn(BoxIndex) -> bool,
    ) -> Self {
        let CurveKey { class, metric, overlap: min_overlap, difficulty } = *key;
        let label = |(i, line)| label_role(line, class, difficulty, !inside(BoxIndex::Label(i)));
        let labels = frame.labels.iter().enumerate().map(label).collect();
        let detections: Vec<Role> =
            frame.detections.iter().map(|line| detection_role(line, class, difficulty)).collect();
        let forgiving = matches!(metric, Metric::Bbox | Metric::Aos) && difficulty != Difficulty::All;
        FrameMatching {
            frame,
            labels,
            spared: (0..detections.len()).map(|j| !inside(BoxIndex::Detection(j))).collect(),
            taken: vec![false; detections.len()],
            hits: vec![false; detections.len()],
            detections,
            pairs: overlaps.of(metric),
            dont_care: if forgiving { &overlaps.dont_care } else { &[] },
            min_overlap,
        }
    }

    /// Ground truths that count.
    pub(crate) fn n_gt(&self) -> i64 {
        self.labels.iter().filter(|role| **role == Role::Counted).count() as i64
    }

    fn score(&self, detection: usize) -> f64 {
        self.frame.detections[detection].score.unwrap_or(0.0)
    }

    /// Half of one plus the cosine of the difference in observation angle.
    fn similarity(&self, label: usize, detection: usize) -> f64 {
        let error = self.frame.labels[label].alpha - self.frame.detections[detection].alpha;
        (1.0 + error.cos()) / 2.0
    }

    /// Scores at which the counts of the second pass change, descending, with the change.
    pub(crate) fn changes(&self) -> Vec<(f64, Counts)> {
        let mut by_score: Vec<usize> =
            (0..self.detections.len()).filter(|&j| self.detections[j] != Role::Absent).collect();
        by_score.sort_by(|&i, &j| self.score(j).total_cmp(&self.score(i)));
        let mut falling = Falling::new(self);
        let (mut changes, mut before) = (Vec::new(), falling.counts());
        for equal in by_score.chunk_by(|&i, &j| self.score(i) == self.score(j)) {
            equal.iter().for_each(|&j| falling.add(j));
            let (score, now) = (self.score(equal[0]), falling.counts());
            if now != before {
                changes.push((score, now - before));
                before = now;
            }
        }
        changes
    }

    /// First pass, without a score threshold: each ground truth takes the free detection of highest score among those
    /// with sufficient overlap. Appends the scores of the true positives.
    pub(crate) fn collect_hit_scores(&mut self, scores: &mut Vec<f64>) {
        self.taken.fill(false);
        let mut pairs = self.pairs;
        for label in 0..self.labels.len() {
            let own = split_off_pairs(&mut pairs, label);
            if self.labels[label] == Role::Absent {
                continue;
            }
            let mut best: Option<usize> = None;
            for pair in own.iter().filter(|pair| pair.overlap > self.min_overlap) {
                let j = pair.detection;
                if self.detections[j] == Role::Absent || self.taken[j] {
                    continue;
                }
                if best.is_none_or(|best| self.score(j) > self.score(best)) {
                    best = Some(j);
                }
            }
            let Some(j) = best else { continue };
            self.taken[j] = true;
            if self.labels[label] == Role::Counted && self.detections[j] == Role::Counted {
                scores.push(self.score(j));
            }
        }
    }

    /// Second pass, with detections of at least this score: each ground truth takes the free detection of highest
    /// overlap, and an ignored one only if there is no other. Unmatched detections are false positives unless they
    /// overlap a DontCare region.
    pub(crate) fn count(&mut self, least_score: f64) -> Counts {
        self.taken.fill(false);
        self.hits.fill(false);
        let mut counts = Counts::default();
        let mut pairs = self.pairs;
        for label in 0..self.labels.len() {
            let own = split_off_pairs(&mut pairs, label);
            if self.labels[label] == Role::Absent {
                continue;
            }
            // An ignored detection is stored with overlap 0, so any counted one is better.
            let mut best: Option<(usize, f64)> = None;
            for pair in own.iter().filter(|pair| pair.overlap > self.min_overlap) {
                let j = pair.detection;
                if self.taken[j] || self.score(j) < least_score {
                    continue;
                }
                match self.detections[j] {
                    Role::Counted if best.is_none_or(|(_, overlap)| pair.overlap > overlap) => {
                        best = Some((j, pair.overlap));
                    }
                    Role::Ignored if best.is_none() => best = Some((j, 0.0)),
                    _ => {}
                }
            }
            let counted = self.labels[label] == Role::Counted;
            match best {
                None => counts.fn_ += i64::from(counted),
                Some((j, _)) => {
                    self.taken[j] = true;
                    if counted && self.detections[j] == Role::Counted {
                        counts.tp += 1;
                        self.hits[j] = true;
                        counts.similarity += self.similarity(label, j);
                    }
                }
            }
        }
        for pair in self.dont_care.iter().filter(|pair| pair.overlap > self.min_overlap) {
            self.taken[pair.detection] = true;
        }
        let left_over = (0..self.detections.len()).filter(|&j| {
            self.detections[j] == Role::Counted && !self.taken[j] && !self.spared[j] && self.score(j) >= least_score
        });
        counts.fp = left_over.count() as i64;
        counts
    }
}

#[cfg(test)]
impl FrameMatching<'_> {
    /// Distinct scores of the detections that take part, descending.
    fn distinct_scores(&self) -> Vec<f64> {
        let taking_part = (0..self.detections.len()).filter(|&j| self.detections[j] != Role::Absent);
        let mut scores: Vec<f64> = taking_part.map(|j| self.score(j)).collect();
        scores.sort_by(|a, b| b.total_cmp(a));
        scores.dedup();
        scores
    }
}

impl FrameMatching<'_> {
    /// Outcome of each detection without a score threshold: true positive (`true`), false positive (`false`), or
    /// `None` if not counted.
    pub(crate) fn outcomes(&mut self) -> Vec<Option<bool>> {
        self.count(f64::NEG_INFINITY);
        let outcome = |j: usize| match self.detections[j] {
            Role::Counted if self.hits[j] => Some(true),
            Role::Counted if !self.taken[j] && !self.spared[j] => Some(false),
            _ => None,
        };
        (0..self.detections.len()).map(outcome).collect()
    }
}

/// Splits off the leading pairs that belong to one label.
fn split_off_pairs<'a>(pairs: &mut &'a [Pair], label: usize) -> &'a [Pair] {
    let (own, rest) = pairs.split_at(pairs.iter().take_while(|pair| pair.label == label).count());
    *pairs = rest;
    own
}

fn label_role(line: &LabelBox, class: &str, difficulty: Difficulty, far: bool) -> Role {
    let is = |name: &str| line.class.eq_ignore_ascii_case(name);
    let neighbour = difficulty != Difficulty::All
        && ((class.eq_ignore_ascii_case("Car") && is("Van"))
            || (class.eq_ignore_ascii_case("Pedestrian") && is("Person_sitting")));
    let filtered = line.occlusion > difficulty.most_occlusion()
        || line.truncation > difficulty.most_truncation()
        || line.image_box[3] - line.image_box[1] <= difficulty.least_height_px();
    match (is(class), neighbour) {
        (true, _) if !filtered && !far => Role::Counted,
        (true, _) | (_, true) => Role::Ignored,
        _ => Role::Absent,
    }
}

fn detection_role(line: &LabelBox, class: &str, difficulty: Difficulty) -> Role {
    if (line.image_box[3] - line.image_box[1]).abs() < difficulty.least_height_px() {
        Role::Ignored // of any class: the reference checks the height first
    } else if line.class.eq_ignore_ascii_case(class) {
        Role::Counted
    } else {
        Role::Absent
    }
}
