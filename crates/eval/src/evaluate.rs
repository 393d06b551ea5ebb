//! Evaluation of frames: one row per class, metric, overlap limit and difficulty.

use crate::curve::{CountsByScore, PrecisionCurve, ceiling_ap40};
use crate::evidence::FrameEvidence;
use crate::matching::{BoxIndex, CurveKey};
use crate::overlaps::{FrameOverlaps, range_m};
use crate::recall::{Recall, RecallDefinition, any_box_recall};
use crate::report::{EvalReport, OverlapSet, Row, SCHEMA};
use crate::{Difficulty, EvalFrame, EvalOptions, Metric, default_classes, reference_overlaps};
use rayon::prelude::*;

/// One precision-recall curve to compute.
struct Job {
    class: String,
    metric: Metric,
    overlap: f64,
    overlap_sets: Vec<OverlapSet>,
    difficulty: Difficulty,
}

/// Evaluates detections against labels: every class, metric, overlap limit and difficulty, and recall. The result does
/// not depend on the number of threads.
pub fn evaluate(frames: &[EvalFrame], options: &EvalOptions) -> EvalReport {
    let classes = if options.classes.is_empty() { default_classes(frames) } else { options.classes.clone() };
    let with_overlaps: Vec<(&EvalFrame, FrameOverlaps)> =
        frames.par_iter().map(|frame| (frame, FrameOverlaps::new(frame, options.label_frame))).collect();
    let orientation = has_orientation(frames);
    let rows: Vec<Row> = jobs(&classes, options)
        .into_par_iter()
        .flat_map_iter(|job| draw(job, &with_overlaps, options, orientation))
        .collect();

    let mut recall = any_box_recall(&with_overlaps, &classes, options);
    recall.extend(
        rows.iter().filter(|row| row.metric == Metric::ThreeD && row.difficulty == Difficulty::All).map(|row| {
            Recall::new(RecallDefinition::Matched, Some(row.class.clone()), row.overlap, row.n_gt, row.n_tp)
        }),
    );
    EvalReport {
        schema: SCHEMA.into(),
        frames: frames.len(),
        label_frame: options.label_frame,
        max_range_m: options.max_range_m,
        notes: notes(frames),
        rows,
        recall,
    }
}

fn jobs(classes: &[String], options: &EvalOptions) -> Vec<Job> {
    let mut jobs = Vec::new();
    for class in classes {
        for metric in [Metric::Bbox, Metric::Bev, Metric::ThreeD] {
            let [official, loose] = reference_overlaps(class, metric);
            let named = [(official, OverlapSet::Official), (loose, OverlapSet::Loose)];
            let given = options.more_overlaps.iter().map(|overlap| (*overlap, OverlapSet::Given));
            let mut limits: Vec<(f64, Vec<OverlapSet>)> = Vec::new();
            for (overlap, set) in named.into_iter().chain(given) {
                match limits.iter_mut().find(|(known, _)| *known == overlap) {
                    Some((_, sets)) => sets.push(set),
                    None => limits.push((overlap, vec![set])),
                }
            }
            for (overlap, overlap_sets) in limits {
                jobs.extend(Difficulty::ALL.map(|difficulty| Job {
                    class: class.clone(),
                    metric,
                    overlap,
                    overlap_sets: overlap_sets.clone(),
                    difficulty,
                }));
            }
        }
    }
    jobs
}

/// Computes the row of a job; for image boxes, the AOS row as well.
fn draw(job: Job, frames: &[(&EvalFrame, FrameOverlaps)], options: &EvalOptions, orientation: bool) -> Vec<Row> {
    let near = |frame: &EvalFrame, index: BoxIndex| {
        let line = match index {
            BoxIndex::Label(i) => &frame.labels[i],
            BoxIndex::Detection(j) => &frame.detections[j],
        };
        options.max_range_m.is_none_or(|most| range_m(line, options.label_frame) <= most)
    };
    let key = CurveKey { class: &job.class, metric: job.metric, overlap: job.overlap, difficulty: job.difficulty };
    let (mut n_gt, mut hit_scores, mut changes) = (0, Vec::new(), Vec::new());
    for (frame, overlaps) in frames {
        let found = FrameEvidence::collect((frame, overlaps), &key, |index| near(frame, index));
        n_gt += found.n_gt;
        hit_scores.extend(found.hit_scores);
        changes.extend(found.changes);
    }
    let counts = CountsByScore::new(changes, n_gt);
    let all = counts.all();
    let row = |metric: Metric| {
        let similarity = metric == Metric::Aos;
        let curve = PrecisionCurve::new(&hit_scores, n_gt, &counts, similarity);
        let defined = !similarity || orientation;
        let note = if !defined {
            Some("undefined: the first detection has no observation angle (alpha is -10), or there is none".into())
        } else if n_gt == 0 {
            Some("no ground truth: 0 by the reference's definition".into())
        } else if curve.undefined_points() > 0 {
            let n = curve.undefined_points();
            Some(format!(
                "precision is 0/0 at {n} of {} score limits; an AP over such a point is undefined",
                curve.counts.len()
            ))
        } else {
            None
        };
        Row {
            class: job.class.clone(),
            metric,
            overlap: job.overlap,
            overlap_sets: job.overlap_sets.clone(),
            difficulty: job.difficulty,
            ap11: curve.ap11().filter(|_| defined),
            ap40: curve.ap40().filter(|_| defined),
            ap_area: Some(counts.exact_area(n_gt, similarity)).filter(|_| defined),
            n_gt,
            n_tp: all.tp,
            n_fp: all.fp,
            n_fn: all.fn_,
            recall: (n_gt > 0).then(|| all.tp as f64 / n_gt as f64),
            ceiling_ap40: ceiling_ap40(n_gt),
            note,
            curve,
        }
    };
    match job.metric {
        Metric::Bbox => vec![row(Metric::Bbox), row(Metric::Aos)],
        metric => vec![row(metric)],
    }
}

/// OpenPCDet's rule: AOS is evaluated if the first detection of the first frame with detections has an observation
/// angle (alpha).
fn has_orientation(frames: &[EvalFrame]) -> bool {
    frames.iter().flat_map(|frame| &frame.detections).next().is_some_and(|line| line.alpha != -10.0)
}

fn notes(frames: &[EvalFrame]) -> Vec<String> {
    let mut notes = Vec::new();
    let labels = || frames.iter().flat_map(|f| &f.labels).filter(|line| !line.is_dont_care());
    let detections = || frames.iter().flat_map(|f| &f.detections);
    let first = labels().next().map(|line| line.image_box);
    if labels().count() > 1 && labels().all(|line| Some(line.image_box) == first) {
        notes.push(
            "all labels have the same image box, as data without images has: bbox and aos say nothing, and easy, moderate \
             and hard are one"
                .into(),
        );
    }
    let low = detections().filter(|line| (line.image_box[3] - line.image_box[1]).abs() < 25.0).count();
    if low > 0 {
        let of = detections().count();
        notes.push(format!(
            "{low} of {of} detections have an image box under 25 px: easy, moderate and hard ignore them (KITTI's rule), \
             and what they cover is neither hit nor miss; `all` counts them"
        ));
    }
    notes
}
