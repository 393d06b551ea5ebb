//! Differences of one detector between two test sets that hold the same moments, for example measured and simulated
//! frames: the same frames are drawn for both sets, so that what both have in common cancels.

use super::scores::RunScores;
use super::{MatrixOptions, Quantity};
use crate::bootstrap::Interval;
use crate::{BootstrapOptions, RangeSection};
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};

/// Difference of a value between two test sets over their shared frames.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct PairedDifference {
    /// Name of the detector.
    pub network: String,
    /// Name of the first test set.
    pub test_set: String,
    /// Name of the test set whose value is subtracted.
    pub compared_to: String,
    /// Number of frames that both test sets have. Values are over these frames only.
    pub frames: usize,
    /// Class name.
    pub class: String,
    /// Range section; `None`: full range.
    pub section: Option<RangeSection>,
    /// The metric.
    pub quantity: Quantity,
    /// 3D IoU threshold.
    pub overlap: f64,
    /// Value on the first test set, percent; `None` where undefined.
    pub value: Option<f64>,
    /// Value on the other test set, percent; `None` where undefined.
    pub other: Option<f64>,
    /// The first value minus the other, percentage points.
    pub difference: Option<f64>,
    /// Bootstrap interval of the difference: the same frame resamples for both test sets.
    pub interval: Option<Interval>,
}

/// A value on several test sets over the same resamples of their shared frames.
#[derive(Clone, Debug)]
pub struct PairedValues {
    /// Class name.
    pub class: String,
    /// Range section; `None`: full range.
    pub section: Option<RangeSection>,
    /// The metric.
    pub quantity: Quantity,
    /// 3D IoU threshold.
    pub overlap: f64,
    /// Value on each test set, percent; NaN where undefined.
    pub values: Vec<f64>,
    /// For each test set, its value in each bootstrap replicate.
    pub draws: Vec<Vec<f64>>,
}

/// Scores of a detector on a test set, with the ids of its frames in their order.
pub type ScoredFrames<'a> = (&'a RunScores, &'a [String]);

/// The frame ids that all test sets have, in the order of the first.
pub fn shared_ids(sets: &[&[String]]) -> Vec<String> {
    let Some((first, others)) = sets.split_first() else { return Vec::new() };
    let others: Vec<BTreeSet<&String>> = others.iter().map(|ids| ids.iter().collect()).collect();
    first.iter().filter(|id| others.iter().all(|ids| ids.contains(id))).cloned().collect()
}

/// Evaluates each test set on the frames that all of them have: every class, range section, overlap and metric. A
/// bootstrap replicate draws the same frames for all test sets. The result does not depend on the number of threads.
pub fn paired_values(sets: &[ScoredFrames<'_>], options: &MatrixOptions) -> (usize, Vec<PairedValues>) {
    let ids: Vec<&[String]> = sets.iter().map(|(_, ids)| *ids).collect();
    let shared = shared_ids(&ids);
    let places: Vec<Vec<usize>> = ids.iter().map(|ids| places_of(&shared, ids)).collect();
    // Weights of the frames of each test set, for the weights of the shared frames.
    let spread = |weights: &dyn Fn(usize) -> u32| -> Vec<Vec<u32>> {
        let of_set = |(ids, places): (&&[String], &Vec<usize>)| {
            let mut of_frames = vec![0; ids.len()];
            places.iter().enumerate().for_each(|(i, place)| of_frames[*place] = weights(i));
            of_frames
        };
        ids.iter().zip(&places).map(of_set).collect()
    };
    let once = spread(&|_| 1);
    let n_curves = sets.iter().map(|(scores, _)| scores.curves.len()).min().unwrap_or(0);
    let numbers = |k: usize, weights: &[Vec<u32>]| -> Vec<[f64; Quantity::ALL.len()]> {
        sets.iter().zip(weights).map(|((scores, _), weights)| scores.curves[k].numbers(Some(weights)).0).collect()
    };
    let whole: Vec<_> = (0..n_curves).map(|k| numbers(k, &once)).collect();
    let bootstrap = &options.bootstrap;
    let drawn: Vec<Vec<_>> = (0..bootstrap.replicates)
        .into_par_iter()
        .map(|replicate| {
            let weights = bootstrap.frame_weights("matrix paired frames", replicate, shared.len());
            let weights = spread(&|i| weights[i]);
            (0..n_curves).map(|k| numbers(k, &weights)).collect()
        })
        .collect();
    let mut out = Vec::new();
    for k in 0..n_curves {
        let curve = &sets[0].0.curves[k];
        for (q, quantity) in Quantity::ALL.into_iter().enumerate() {
            out.push(PairedValues {
                class: curve.class.clone(),
                section: curve.section,
                quantity,
                overlap: curve.overlap,
                values: whole[k].iter().map(|of_set| of_set[q]).collect(),
                draws: (0..sets.len()).map(|s| drawn.iter().map(|of| of[k][s][q]).collect()).collect(),
            });
        }
    }
    (shared.len(), out)
}

/// The place of each shared id among `ids`.
fn places_of(shared: &[String], ids: &[String]) -> Vec<usize> {
    let known: BTreeMap<&String, usize> = ids.iter().enumerate().map(|(i, id)| (id, i)).collect();
    shared.iter().filter_map(|id| known.get(id).copied()).collect()
}

impl PairedValues {
    /// The value on test set `a` minus that on test set `b`, with its interval.
    pub fn difference(&self, a: usize, b: usize, bootstrap: &BootstrapOptions) -> (Option<f64>, Option<Interval>) {
        let difference = Some(self.values[a] - self.values[b]).filter(|v| !v.is_nan());
        let draws = self.draws[a].iter().zip(&self.draws[b]).map(|(a, b)| a - b).collect();
        (difference, difference.and_then(|_| bootstrap.interval(draws)))
    }
}

/// All differences between two test sets of one detector. `names` are those of the detector, the first test set, and
/// the one that is subtracted.
pub fn paired_differences(
    names: [&str; 3],
    sets: [ScoredFrames<'_>; 2],
    options: &MatrixOptions,
) -> Vec<PairedDifference> {
    let (frames, values) = paired_values(&sets, options);
    let defined = |v: f64| Some(v).filter(|v| !v.is_nan());
    let of_value = |v: PairedValues| {
        let (difference, interval) = v.difference(0, 1, &options.bootstrap);
        PairedDifference {
            network: names[0].into(),
            test_set: names[1].into(),
            compared_to: names[2].into(),
            frames,
            class: v.class,
            section: v.section,
            quantity: v.quantity,
            overlap: v.overlap,
            value: defined(v.values[0]),
            other: defined(v.values[1]),
            difference,
            interval,
        }
    };
    values.into_iter().map(of_value).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::EvalFrame;
    use data::{LabelBox, LabelFrame};
    use geometry::Box3;

    /// Frames with one car each; it is found where `found` says so.
    fn frames(ids: &[&str], found: impl Fn(usize) -> bool) -> Vec<EvalFrame> {
        let car = |i: usize, score| {
            LabelBox::from_box("Car", &Box3::from_array([10.0 + 0.5 * i as f64, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0]), score)
        };
        let of = |(i, id): (usize, &&str)| EvalFrame {
            id: (*id).into(),
            labels: vec![car(i, None)],
            detections: found(i).then(|| car(i, Some(0.5 + i as f32 / 1000.0))).into_iter().collect(),
        };
        ids.iter().enumerate().map(of).collect()
    }

    fn options() -> MatrixOptions {
        let bootstrap = BootstrapOptions { replicates: 200, ..BootstrapOptions::default() };
        MatrixOptions { bootstrap, sections: Vec::new(), overlaps: vec![0.5], ..MatrixOptions::default() }
    }

    fn scored(frames: &[EvalFrame]) -> (RunScores, Vec<String>) {
        let ids = frames.iter().map(|f| f.id.clone()).collect();
        (RunScores::new(frames, None, LabelFrame::Lidar, &options()), ids)
    }

    fn recall(found: &[PairedDifference]) -> &PairedDifference {
        found.iter().find(|d| d.quantity == Quantity::RecallMatched).unwrap()
    }

    #[test]
    fn what_both_sets_miss_cancels() {
        let names: Vec<String> = (0..100).map(|i| format!("{i:06}")).collect();
        let ids: Vec<&str> = names.iter().map(String::as_str).collect();
        let (a, a_ids) = scored(&frames(&ids, |i| i % 2 == 0));
        let same = paired_differences(["d", "a", "b"], [(&a, &a_ids), (&a, &a_ids)], &options());
        let same = recall(&same);
        assert_eq!((same.value, same.difference), (Some(50.0), Some(0.0)));
        assert_eq!(same.interval, Some(Interval { low: 0.0, high: 0.0 }), "no noise of the frames is left");

        let (b, b_ids) = scored(&frames(&ids, |i| i % 2 == 0 && i % 10 > 0));
        let less = paired_differences(["d", "a", "b"], [(&a, &a_ids), (&b, &b_ids)], &options());
        let less = recall(&less);
        assert!((less.difference.unwrap() - 10.0).abs() < 1e-9);
        let interval = less.interval.unwrap();
        assert!(interval.low > 3.0 && interval.high < 18.0, "{interval:?}");
    }

    #[test]
    fn only_shared_frames_count_in_any_order() {
        let (a, a_ids) = scored(&frames(&["1", "2", "3", "4"], |i| i < 2));
        let (b, b_ids) = scored(&frames(&["9", "3", "2"], |i| i > 0));
        let found = paired_differences(["d", "a", "b"], [(&a, &a_ids), (&b, &b_ids)], &options());
        let found = recall(&found);
        assert_eq!((found.frames, found.value, found.other), (2, Some(50.0), Some(100.0)));
        assert_eq!(shared_ids(&[&a_ids, &b_ids]), ["2", "3"]);
    }

    #[test]
    fn without_ground_truth_there_is_no_difference() {
        let mut empty = frames(&["1", "2"], |_| true);
        empty.iter_mut().for_each(|frame| frame.labels.clear());
        let (a, a_ids) = scored(&empty);
        let found = paired_differences(["d", "a", "b"], [(&a, &a_ids), (&a, &a_ids)], &options());
        assert!(found.iter().all(|d| d.difference.is_none() && d.interval.is_none()));
    }
}
