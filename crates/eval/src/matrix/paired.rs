//! Differences of one detector between two test sets that hold the same moments, for example measured and simulated
//! frames: the same frames are drawn for both sets, so that what both have in common cancels.

use super::scores::{Curves, RunScores};
use super::{MatrixOptions, Part, Quantity, Reference};
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
    /// The parts of the difference, where the truth beside the labels of one of the two is known, or a test set with
    /// the scenes of the one and the sensor of the other.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub parts: Option<PairedParts>,
}

/// The parts of a paired difference; `label` and `sensor_and_scene` add up to it, `sensor` and `scene` to the latter.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct PairedParts {
    /// Values against the labels less values against the true boxes or the repaired labels, on the first test set
    /// less on the other; `None` where neither is known of either.
    pub label: Option<Part>,
    /// Difference of the values against the best boxes that are known.
    pub sensor_and_scene: Part,
    /// The part of it that the sensor takes: the value with the sensor of the first test set and the scenes of the
    /// other, less that on the other. `None` without such a test set.
    pub sensor: Option<Part>,
    /// The part of it that the scene takes.
    pub scene: Option<Part>,
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

/// Scores of a detector on a test set.
#[derive(Clone, Copy, Debug)]
pub struct ScoredFrames<'a> {
    /// The scores.
    pub scores: &'a RunScores,
    /// Ids of its frames in their order.
    pub ids: &'a [String],
    /// The boxes that values are read against.
    pub reference: Reference,
}

impl<'a> ScoredFrames<'a> {
    /// Scores against the labels.
    pub fn new(scores: &'a RunScores, ids: &'a [String]) -> Self {
        ScoredFrames { scores, ids, reference: Reference::Labels }
    }

    /// The same against the boxes that come closest to the truth.
    fn best(self) -> Self {
        ScoredFrames { reference: self.scores.closest(), ..self }
    }
}

/// The frame ids that all test sets have, in the order of the first.
pub fn shared_ids(sets: &[&[String]]) -> Vec<String> {
    let Some((first, others)) = sets.split_first() else { return Vec::new() };
    let others: Vec<BTreeSet<&String>> = others.iter().map(|ids| ids.iter().collect()).collect();
    first.iter().filter(|id| others.iter().all(|ids| ids.contains(id))).cloned().collect()
}

/// Evaluates each test set on the frames that all of them have: every class, range section, overlap and metric. A
/// bootstrap replicate draws the same frames for all test sets. The result does not depend on the number of threads.
pub fn paired_values(sets: &[ScoredFrames<'_>], options: &MatrixOptions) -> (usize, Vec<PairedValues>) {
    let ids: Vec<&[String]> = sets.iter().map(|set| set.ids).collect();
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
    let curves: Vec<Curves> = sets.iter().map(|set| set.scores.curves_of(set.reference)).collect();
    let n_curves = curves.iter().map(|curves| curves.estimate.len()).min().unwrap_or(0);
    let numbers = |k: usize, weights: &[Vec<u32>], version: usize| -> Vec<[f64; Quantity::ALL.len()]> {
        let of_set = |(curves, weights): (&Curves, &Vec<u32>)| curves.version(version)[k].numbers(Some(weights)).0;
        curves.iter().zip(weights).map(of_set).collect()
    };
    let whole: Vec<_> = (0..n_curves).map(|k| numbers(k, &once, 0)).collect();
    let bootstrap = &options.bootstrap;
    let drawn: Vec<Vec<_>> = (0..bootstrap.replicates)
        .into_par_iter()
        .map(|replicate| {
            let weights = bootstrap.frame_weights("matrix paired frames", replicate, shared.len());
            let weights = spread(&|i| weights[i]);
            let version = bootstrap.version_draw(replicate);
            (0..n_curves).map(|k| numbers(k, &weights, version)).collect()
        })
        .collect();
    let mut out = Vec::new();
    for k in 0..n_curves {
        let curve = &curves[0].estimate[k];
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

    /// The same as a part of a difference; `None` where undefined.
    fn part(&self, a: usize, b: usize, bootstrap: &BootstrapOptions) -> Option<Part> {
        let (points, interval) = self.difference(a, b, bootstrap);
        Some(Part { points: points?, interval })
    }
}

/// Scores on a test set that stands between the two of a difference.
#[derive(Clone, Copy, Debug)]
pub enum Standing<'a> {
    /// It has the sensor of the first test set and the scenes of the other.
    SensorOfFirst(ScoredFrames<'a>),
    /// It has the scenes of the first test set and the sensor of the other.
    SceneOfFirst(ScoredFrames<'a>),
}

impl<'a> Standing<'a> {
    fn frames(self) -> ScoredFrames<'a> {
        match self {
            Standing::SensorOfFirst(frames) | Standing::SceneOfFirst(frames) => frames,
        }
    }
}

/// All differences between two test sets of one detector. `names` are those of the detector, the first test set, and
/// the one that is subtracted. `between` are the scores on a test set with the sensor of the first and the scenes of
/// the other, or with the scenes of the first and the sensor of the other.
pub fn paired_differences(
    names: [&str; 3],
    [first, other]: [ScoredFrames<'_>; 2],
    between: Option<Standing<'_>>,
    options: &MatrixOptions,
) -> Vec<PairedDifference> {
    let mut sets = vec![first, other];
    // Where the scores against the best boxes are; those against the labels if nothing better is known.
    let mut best = [0, 1];
    for (place, set) in best.iter_mut().zip([first, other]) {
        if set.best().reference != set.reference {
            *place = sets.len();
            sets.push(set.best());
        }
    }
    let [one, two] = best;
    let (has_truth, middle) = (sets.len() > 2, sets.len());
    sets.extend(between.map(|between| between.frames().best()));
    let (frames, values) = paired_values(&sets, options);
    let defined = |v: f64| Some(v).filter(|v| !v.is_nan());
    let parts = |v: &PairedValues| {
        let bootstrap = &options.bootstrap;
        let sensor_and_scene = (sets.len() > 2).then(|| v.part(one, two, bootstrap)).flatten()?;
        let label = || {
            let less = |of: &dyn Fn(usize) -> f64| (of(0) - of(one)) - (of(1) - of(two));
            let points = less(&|set| v.values[set]);
            let draws = (0..v.draws[0].len()).map(|r| less(&|set| v.draws[set][r]));
            defined(points).map(|points| Part { points, interval: bootstrap.interval(draws.collect()) })
        };
        let [sensor, scene] = match between {
            Some(Standing::SensorOfFirst(_)) => [v.part(middle, two, bootstrap), v.part(one, middle, bootstrap)],
            Some(Standing::SceneOfFirst(_)) => [v.part(one, middle, bootstrap), v.part(middle, two, bootstrap)],
            None => [None, None],
        };
        Some(PairedParts { label: has_truth.then(label).flatten(), sensor_and_scene, sensor, scene })
    };
    let of_value = |v: PairedValues| {
        let (difference, interval) = v.difference(0, 1, &options.bootstrap);
        let parts = parts(&v);
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
            parts,
        }
    };
    values.into_iter().map(of_value).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::EvalFrame;
    use crate::matrix::TestSet;
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

    fn differences(a: (&RunScores, &Vec<String>), b: (&RunScores, &Vec<String>)) -> Vec<PairedDifference> {
        let sets = [a, b].map(|(scores, ids)| ScoredFrames::new(scores, ids));
        paired_differences(["d", "a", "b"], sets, None, &options())
    }

    fn recall(found: &[PairedDifference]) -> &PairedDifference {
        found.iter().find(|d| d.quantity == Quantity::RecallMatched).unwrap()
    }

    #[test]
    fn what_both_sets_miss_cancels() {
        let names: Vec<String> = (0..100).map(|i| format!("{i:06}")).collect();
        let ids: Vec<&str> = names.iter().map(String::as_str).collect();
        let (a, a_ids) = scored(&frames(&ids, |i| i % 2 == 0));
        let same = differences((&a, &a_ids), (&a, &a_ids));
        let same = recall(&same);
        assert_eq!((same.value, same.difference), (Some(50.0), Some(0.0)));
        assert_eq!(same.interval, Some(Interval { low: 0.0, high: 0.0 }), "no noise of the frames is left");

        let (b, b_ids) = scored(&frames(&ids, |i| i % 2 == 0 && i % 10 > 0));
        let less = differences((&a, &a_ids), (&b, &b_ids));
        let less = recall(&less);
        assert!((less.difference.unwrap() - 10.0).abs() < 1e-9);
        let interval = less.interval.unwrap();
        assert!(interval.low > 3.0 && interval.high < 18.0, "{interval:?}");
    }

    #[test]
    fn only_shared_frames_count_in_any_order() {
        let (a, a_ids) = scored(&frames(&["1", "2", "3", "4"], |i| i < 2));
        let (b, b_ids) = scored(&frames(&["9", "3", "2"], |i| i > 0));
        let found = differences((&a, &a_ids), (&b, &b_ids));
        let found = recall(&found);
        assert_eq!((found.frames, found.value, found.other), (2, Some(50.0), Some(100.0)));
        assert_eq!(shared_ids(&[&a_ids, &b_ids]), ["2", "3"]);
    }

    #[test]
    fn without_ground_truth_there_is_no_difference() {
        let mut empty = frames(&["1", "2"], |_| true);
        empty.iter_mut().for_each(|frame| frame.labels.clear());
        let (a, a_ids) = scored(&empty);
        let found = differences((&a, &a_ids), (&a, &a_ids));
        assert!(found.iter().all(|d| d.difference.is_none() && d.interval.is_none() && d.parts.is_none()));
    }

    /// Labels are wrong in every fifth frame of the first set, whose sensor misses every third car.
    #[test]
    fn a_difference_is_split_into_label_sensor_and_scene() {
        let names: Vec<String> = (0..120).map(|i| format!("{i:06}")).collect();
        let ids: Vec<&str> = names.iter().map(String::as_str).collect();
        let sensor = |i: usize| !i.is_multiple_of(3);
        let truth = frames(&ids, sensor);
        let mut labelled = truth.clone();
        let elsewhere = Box3::from_array([90.0, 9.0, 0.0, 4.0, 2.0, 1.5, 0.0]);
        let wrong = vec![LabelBox::from_box("Car", &elsewhere, None)];
        labelled.iter_mut().step_by(5).for_each(|frame| frame.labels.clone_from(&wrong));
        let (measured, a_ids) = scored(&labelled);
        let set = TestSet::new(LabelFrame::Lidar, labelled.clone());
        let set = set.with_beside(Reference::TrueBoxes, vec![truth.iter().map(|frame| frame.labels.clone()).collect()]);
        assert!(measured.is_same_as(&set.scores(&labelled, None, &options())));
        let measured = set.scores(&labelled, None, &options());
        let (sim, b_ids) = scored(&frames(&ids, |_| true));
        let (a, b) = (ScoredFrames::new(&measured, &a_ids), ScoredFrames::new(&sim, &b_ids));
        let points = |part: Option<Part>| part.map(|part| (part.points * 1e6).round() / 1e6);
        // Found are 80 of 120; of them 16 are in frames with a wrong label.
        let plain = paired_differences(["d", "a", "b"], [a, b], None, &options());
        let (plain, parts) = (recall(&plain), recall(&plain).parts.unwrap());
        assert_eq!((plain.value, plain.other), (Some(100.0 * 64.0 / 120.0), Some(100.0)));
        assert_eq!(points(parts.label), Some(-13.333333));
        assert_eq!((points(Some(parts.sensor_and_scene)), parts.sensor), (Some(-33.333333), None));
        let interval = parts.label.unwrap().interval.unwrap();
        assert!(interval.low > -22.0 && interval.high < -6.0, "{interval:?}");
        // The scenes of the second set seen by the sensor of the first: all of it is the sensor.
        let (middle, ids) = scored(&truth);
        let standing = Standing::SensorOfFirst(ScoredFrames::new(&middle, &ids));
        let parts = recall(&paired_differences(["d", "a", "b"], [a, b], Some(standing), &options())).parts.unwrap();
        assert_eq!((points(parts.sensor), points(parts.scene)), (Some(-33.333333), Some(0.0)));
        let standing = Standing::SceneOfFirst(ScoredFrames::new(&middle, &ids));
        let parts = recall(&paired_differences(["d", "a", "b"], [a, b], Some(standing), &options())).parts.unwrap();
        assert_eq!((points(parts.sensor), points(parts.scene)), (Some(0.0), Some(-33.333333)));
        // Exact labels on both sides, no truth beside them: no parts.
        let exact = paired_differences(["d", "b", "b"], [b, b], None, &options());
        assert_eq!(recall(&exact).parts, None);
    }
}
