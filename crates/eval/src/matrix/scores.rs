//! Scores of one run on one test set.

use super::{MatrixOptions, Quantity, Reference};
use crate::evidence::{Evidence, FrameEvidence};
use crate::matching::{BoxIndex, CurveKey};
use crate::overlaps::{FrameOverlaps, range_m};
use crate::{EvalFrame, Metric, RangeSection, detections_of};
use data::{DataError, Dataset, LabelBox, LabelFrame};
use rayon::prelude::*;
use sha2::{Digest, Sha256};
use std::path::Path;

/// The labels of a test set, read once for all runs.
#[derive(Clone, Debug, PartialEq)]
pub struct TestSet {
    /// The frame of labels and detections.
    pub label_frame: LabelFrame,
    frames: Vec<EvalFrame>,
    /// What is known beside the labels, with its versions.
    beside: Vec<(Reference, Versions)>,
}

/// Versions of the boxes of all frames: the estimate, and if its uncertainty is known both ends.
pub type Versions = Vec<Vec<Vec<LabelBox>>>;

impl TestSet {
    /// Reads the labels of a data set's split.
    ///
    /// # Errors
    /// A missing or invalid label file.
    pub fn read(dataset: &Dataset, split: &str) -> Result<Self, DataError> {
        let ids = dataset.ids(split)?;
        let read = |id: &String| Ok(EvalFrame { id: id.clone(), labels: dataset.labels(id)?, detections: vec![] });
        // Collects all results first, so that the first bad frame is reported for any number of threads.
        let frames: Vec<Result<EvalFrame, DataError>> = ids.par_iter().map(read).collect();
        let frames = frames.into_iter().collect::<Result<_, _>>()?;
        let mut beside = Vec::new();
        let repaired: Vec<_> = ids.par_iter().map(|id| dataset.repaired_labels(id)).collect();
        if let Some(repaired) = repaired.into_iter().collect::<Result<Option<Vec<_>>, _>>()?.filter(|r| !r.is_empty()) {
            let version = |k: usize| repaired.iter().map(|versions| versions[k].clone()).collect();
            beside.push((Reference::RepairedLabels, (0..3).map(version).collect()));
        }
        let truth: Vec<_> = ids.par_iter().map(|id| dataset.true_labels(id)).collect();
        if let Some(truth) = truth.into_iter().collect::<Result<Option<Vec<_>>, _>>()? {
            beside.push((Reference::TrueBoxes, vec![truth]));
        }
        Ok(TestSet { label_frame: dataset.config.label_frame, frames, beside })
    }

    /// What is known beside the labels, from what is farther from the truth to what is closer.
    pub fn known_beside(&self) -> impl Iterator<Item = Reference> {
        self.beside.iter().map(|(reference, _)| *reference)
    }

    /// These detections, in the order of the test set, with the boxes of a reference as their labels; unchanged if it
    /// is not known.
    pub fn labelled_by(&self, reference: Reference, frames: &[EvalFrame]) -> Vec<EvalFrame> {
        let versions = self.beside.iter().find(|(known, _)| *known == reference).map(|(_, versions)| versions);
        versions.map_or_else(|| frames.to_vec(), |versions| with_labels(frames, &versions[0]))
    }

    /// Scores of detections of this test set, and of the regions of a two-stage network, against the labels that they
    /// have and against all that is known beside.
    pub fn scores(&self, frames: &[EvalFrame], regions: Option<&[EvalFrame]>, options: &MatrixOptions) -> RunScores {
        let mut scores = RunScores::new(frames, regions, self.label_frame, options);
        for (reference, versions) in &self.beside {
            let of_version = |boxes: &Vec<Vec<LabelBox>>| {
                let regions = regions.map(|regions| with_labels(regions, boxes));
                let frames = with_labels(frames, boxes);
                RunScores::new(&frames, regions.as_deref(), self.label_frame, options).curves
            };
            scores.beside.push((*reference, versions.iter().map(of_version).collect()));
        }
        scores
    }

    /// From labels in memory; detections in the frames are dropped.
    pub fn new(label_frame: LabelFrame, mut frames: Vec<EvalFrame>) -> Self {
        frames.iter_mut().for_each(|frame| frame.detections.clear());
        TestSet { label_frame, frames, beside: Vec::new() }
    }

    /// With boxes in memory that are known beside the labels: the estimate and, if its uncertainty is known, both ends,
    /// each frame by frame. Call it in the order of [`Reference::ALL`].
    #[must_use]
    pub fn with_beside(mut self, reference: Reference, versions: Versions) -> Self {
        self.beside.push((reference, versions));
        self
    }

    /// The frames with their labels, without detections.
    pub fn frames(&self) -> &[EvalFrame] {
        &self.frames
    }

    /// Number of frames.
    pub fn len(&self) -> usize {
        self.frames.len()
    }

    /// Whether there are no frames.
    pub fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }

    /// The frames with the detections of a run, read as [`detections_of`] does.
    ///
    /// # Errors
    /// Missing or invalid detections of a frame.
    pub fn with_detections(&self, path: &Path) -> Result<Vec<EvalFrame>, DataError> {
        let ids: Vec<&str> = self.frames.iter().map(|frame| frame.id.as_str()).collect();
        let with = |(frame, detections): (&EvalFrame, _)| EvalFrame {
            id: frame.id.clone(),
            labels: frame.labels.clone(),
            detections,
        };
        Ok(self.frames.iter().zip(detections_of(path, &ids)?).map(with).collect())
    }
}

/// Scores of one run on one test set, in a form that allows its curves to be recomputed for any resample of frames.
#[derive(Clone, Debug)]
pub struct RunScores {
    pub(super) frames: usize,
    /// Hash of the frame ids. Test sets with the same frames are resampled alike.
    pub(super) frames_key: String,
    pub(super) curves: Vec<RunCurve>,
    /// The same against what is known beside the labels, in versions.
    beside: Vec<(Reference, Vec<Vec<RunCurve>>)>,
}

/// The curves of a run against a reference.
#[derive(Clone, Copy)]
pub(super) struct Curves<'a> {
    /// Against the estimate of the boxes; empty if the reference is not known.
    pub estimate: &'a [RunCurve],
    /// Against the ends of their interval.
    ends: &'a [Vec<RunCurve>],
}

impl<'a> Curves<'a> {
    /// Against a version of the boxes, 0 the estimate, then the ends; the estimate if there are no ends.
    pub fn version(self, k: usize) -> &'a [RunCurve] {
        k.checked_sub(1).and_then(|end| self.ends.get(end)).map_or(self.estimate, Vec::as_slice)
    }
}

/// These frames with other labels.
fn with_labels(frames: &[EvalFrame], labels: &[Vec<LabelBox>]) -> Vec<EvalFrame> {
    let frame = |(frame, labels): (&EvalFrame, &Vec<LabelBox>)| EvalFrame {
        id: frame.id.clone(),
        labels: labels.clone(),
        detections: frame.detections.clone(),
    };
    frames.iter().zip(labels).map(frame).collect()
}

/// One class, range section and overlap of a run.
#[derive(Clone, Debug)]
pub(super) struct RunCurve {
    pub class: String,
    pub section: Option<RangeSection>,
    pub overlap: f64,
    evidence: Evidence,
    bev: Evidence,
    /// Per frame: ground truths, those covered by any region, and those covered by any detection.
    covered: Vec<[u32; 3]>,
}

impl RunScores {
    /// Computes the scores of a run's detections. Every overlap is computed once.
    ///
    /// `regions` are the boxes for OpenPCDet's recall, if they differ from the detections: for two-stage networks, all
    /// refined RoIs before the score threshold and the final NMS. They are in the order of `frames`.
    pub fn new(
        frames: &[EvalFrame],
        regions: Option<&[EvalFrame]>,
        label_frame: LabelFrame,
        options: &MatrixOptions,
    ) -> Self {
        let overlaps: Vec<FrameOverlaps> = frames.par_iter().map(|f| FrameOverlaps::new(f, label_frame)).collect();
        let of_regions: Option<Vec<FrameOverlaps>> =
            regions.map(|r| r.par_iter().map(|f| FrameOverlaps::new(f, label_frame)).collect());
        let recall_overlaps = of_regions.as_ref().unwrap_or(&overlaps);
        let mut keys = Vec::new();
        for class in &options.classes {
            for section in std::iter::once(None).chain(options.sections.iter().copied().map(Some)) {
                keys.extend(options.overlaps.iter().map(|overlap| (class.clone(), section, *overlap)));
            }
        }
        let curve = |(class, section, overlap): (String, Option<RangeSection>, f64)| {
            let whole = options.max_range_m.map(RangeSection::up_to);
            let looked_at = section.or(whole);
            let inside = |line| looked_at.is_none_or(|s| s.contains(range_m(line, label_frame)));
            let [evidence, bev] = [Metric::ThreeD, Metric::Bev].map(|metric| {
                let key = CurveKey { class: &class, metric, overlap, difficulty: options.difficulty };
                Evidence::new(frames.iter().zip(&overlaps).map(|(frame, overlaps)| {
                    FrameEvidence::collect((frame, overlaps), &key, |index| match index {
                        BoxIndex::Label(i) => inside(&frame.labels[i]),
                        BoxIndex::Detection(j) => inside(&frame.detections[j]),
                    })
                }))
            });
            let covered = frames
                .iter()
                .zip(recall_overlaps.iter().zip(&overlaps))
                .map(|(frame, (of_any, of_detections))| {
                    let best = [of_any, of_detections].map(|overlaps| highest(overlaps, frame.labels.len()));
                    let counts =
                        |i: &usize| frame.labels[*i].class.eq_ignore_ascii_case(&class) && inside(&frame.labels[*i]);
                    (0..frame.labels.len()).filter(counts).fold([0; 3], |[n, any, found], i| {
                        let hit = |best: &[f64]| u32::from(best[i] > overlap);
                        [n + 1, any + hit(&best[0]), found + hit(&best[1])]
                    })
                })
                .collect();
            RunCurve { class, section, overlap, evidence, bev, covered }
        };
        let ids: String = frames.iter().flat_map(|frame| [frame.id.as_str(), "\n"]).collect();
        let frames_key = Sha256::digest(ids).iter().map(|byte| format!("{byte:02x}")).collect();
        let curves = keys.into_par_iter().map(curve).collect();
        RunScores { frames: frames.len(), frames_key, curves, beside: Vec::new() }
    }

    /// The curves against a reference; none where it is not known.
    pub(super) fn curves_of(&self, reference: Reference) -> Curves<'_> {
        if reference == Reference::Labels {
            return Curves { estimate: &self.curves, ends: &[] };
        }
        let versions = self.beside.iter().find(|(known, _)| *known == reference);
        versions
            .and_then(|(_, versions)| versions.split_first())
            .map_or(Curves { estimate: &[], ends: &[] }, |(estimate, ends)| Curves { estimate, ends })
    }

    /// What comes closest to the truth.
    pub(super) fn closest(&self) -> Reference {
        self.beside.last().map_or(Reference::Labels, |(reference, _)| *reference)
    }

    /// Whether two runs give the same result on every frame. Two seeds that do were the same run, unless they detect
    /// nothing.
    pub(super) fn is_same_as(&self, other: &RunScores) -> bool {
        let finds = self.curves.iter().any(|curve| curve.covered.iter().any(|[_, hits, _]| *hits > 0));
        finds && self.curves.iter().zip(&other.curves).all(|(a, b)| a.evidence == b.evidence && a.covered == b.covered)
    }
}

/// Highest overlap of each label with any box.
fn highest(overlaps: &FrameOverlaps, n_labels: usize) -> Vec<f64> {
    let mut best = vec![0.0f64; n_labels];
    for pair in &overlaps.three_d {
        best[pair.label] = best[pair.label].max(pair.overlap);
    }
    best
}

impl RunCurve {
    /// Values in the order of [`Quantity::ALL`], percent, NaN where undefined; and the number of counted ground
    /// truths.
    pub(super) fn numbers(&self, weights: Option<&[u32]>) -> ([f64; Quantity::ALL.len()], i64) {
        let p = self.evidence.precisions(weights);
        let mut covered = [0u64; 3];
        for (i, of_frame) in self.covered.iter().enumerate() {
            let weight = weights.map_or(1, |w| u64::from(w[i]));
            covered.iter_mut().zip(of_frame).for_each(|(sum, n)| *sum += weight * u64::from(*n));
        }
        let [n, any, found] = covered.map(|n| n as f64);
        let share = |part: f64, of: f64| 100.0 * part / of; // NaN for 0/0
        let or_undefined = |v: f64| if p.n_gt == 0 { f64::NAN } else { v };
        let numbers = [
            or_undefined(p.ap40),
            or_undefined(p.ap_area),
            share(any, n),
            share(p.n_tp as f64, p.n_gt as f64),
            share(found, n),
            or_undefined(self.bev.precisions(weights).ap40),
        ];
        (numbers, p.n_gt)
    }
}
