//! Average precision of subsets of the boxes: by distance, heading, or number of points.

use super::AnalysisOptions;
use crate::evidence::{Evidence, FrameEvidence};
use crate::matching::{BoxIndex, CurveKey};
use crate::overlaps::{FrameOverlaps, range_m, upright_box};
use crate::{Difficulty, EvalFrame, Metric, ceiling_ap40};
use data::{Cloud, LabelBox};
use geometry::{Box3, limit_period, points_in_boxes};
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Deserializer, Serialize};
use std::f64::consts::PI;

/// Evaluation of one subset of the boxes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Stratum {
    /// Lower bound of the binned quantity. For AP by overlap: the IoU threshold.
    pub from: f64,
    /// Upper bound, exclusive; infinite (`null` in JSON) for an open last bin.
    #[serde(deserialize_with = "or_infinite")]
    #[schemars(with = "Option<f64>")]
    pub to: f64,
    /// Ground truths in the subset.
    pub n_gt: i64,
    /// KITTI AP over 40 recall positions, percent; `None` where undefined.
    pub ap40: Option<f64>,
    /// Highest possible AP40 with this number of ground truths, percent.
    pub ceiling_ap40: Option<f64>,
    /// Area under the precision-recall curve with a point at every score, percent; `None` without ground truth.
    pub ap_area: Option<f64>,
    /// Recall, percent; `None` without ground truth.
    pub recall: Option<f64>,
}

fn or_infinite<'de, D: Deserializer<'de>>(from: D) -> Result<f64, D::Error> {
    Ok(Option::<f64>::deserialize(from)?.unwrap_or(f64::INFINITY))
}

/// Number of points of a frame's cloud in each of its boxes.
#[derive(Clone, Debug, PartialEq, Eq, Default)]
pub struct BoxPoints {
    /// Per label.
    pub labels: Vec<u32>,
    /// Per detection.
    pub detections: Vec<u32>,
}

impl BoxPoints {
    /// Counts the points of a cloud in boxes given in the LiDAR frame.
    pub fn count(cloud: &Cloud, labels: &[Box3], detections: &[Box3]) -> Self {
        let count = |boxes: &[Box3]| {
            let inside = points_in_boxes(&cloud.values, cloud.channels, boxes, 0.0);
            inside.iter().map(|points| points.len() as u32).collect()
        };
        BoxPoints { labels: count(labels), detections: count(detections) }
    }
}

/// Whether a box is within [`AnalysisOptions::max_range_m`].
pub(super) fn near(frame: &EvalFrame, index: BoxIndex, options: &AnalysisOptions) -> bool {
    range_m(line(frame, index), options.label_frame) <= options.max_range_m
}

fn line(frame: &EvalFrame, index: BoxIndex) -> &LabelBox {
    match index {
        BoxIndex::Label(i) => &frame.labels[i],
        BoxIndex::Detection(j) => &frame.detections[j],
    }
}

/// By ground-plane distance, in steps of [`AnalysisOptions::step_m`]. Boxes outside a step are ignored, and a
/// detection outside that matches an ignored ground truth is no false positive.
pub fn by_distance(frames: &[EvalFrame], options: &AnalysisOptions) -> Vec<Stratum> {
    let n = (options.max_range_m / options.step_m).ceil().clamp(1.0, 1000.0) as usize;
    let edges: Vec<f64> = (0..=n).map(|i| i as f64 * options.step_m).collect();
    strata(frames, options, &edges, |f, index| range_m(line(&frames[f], index), options.label_frame))
}

/// By heading relative to the ray from the sensor, modulo 180 degrees: 0 is seen from the front or back, 90 from the
/// side. Six bins of 15 degrees.
pub fn by_heading(frames: &[EvalFrame], options: &AnalysisOptions) -> Vec<Stratum> {
    let edges: Vec<f64> = (0..=6).map(|i| f64::from(i) * 15.0 + if i == 6 { 1e-9 } else { 0.0 }).collect();
    strata(frames, options, &edges, |f, index| {
        let b = upright_box(line(&frames[f], index), options.label_frame);
        let ray = b.center[1].atan2(b.center[0]);
        limit_period(b.yaw_rad - ray, 0.5, PI).abs().to_degrees()
    })
}

/// By number of points in the box: in the ground-truth box, or in the detected box of a false positive.
///
/// # Panics
/// If `points` does not match `frames`.
pub fn by_points(frames: &[EvalFrame], points: &[BoxPoints], options: &AnalysisOptions) -> Vec<Stratum> {
    let edges = [0.0, 1.0, 5.0, 20.0, 100.0, 500.0, 2000.0, f64::INFINITY];
    strata(frames, options, &edges, |f, index| {
        f64::from(match index {
            BoxIndex::Label(i) => points[f].labels[i],
            BoxIndex::Detection(j) => points[f].detections[j],
        })
    })
}

/// By IoU threshold, 0.05 to 0.95.
pub fn by_overlap(frames: &[EvalFrame], options: &AnalysisOptions) -> Vec<Stratum> {
    let overlaps = overlaps(frames, options);
    let of_limit = |k: u32| {
        let limit = f64::from(k) / 20.0;
        let evidence = evidence(frames, &overlaps, options, limit, |f, index| near(&frames[f], index, options));
        stratum(limit, limit + 0.05, &evidence)
    };
    (1..20u32).collect::<Vec<_>>().into_par_iter().map(of_limit).collect()
}

/// AP of all boxes at the configured IoU threshold, from precomputed overlaps.
pub(super) fn whole(frames: &[EvalFrame], options: &AnalysisOptions) -> Stratum {
    let overlaps = overlaps(frames, options);
    let near = |f: usize, index| near(&frames[f], index, options);
    stratum(0.0, options.max_range_m, &evidence(frames, &overlaps, options, options.overlap, near))
}

fn strata(
    frames: &[EvalFrame],
    options: &AnalysisOptions,
    edges: &[f64],
    value: impl Fn(usize, BoxIndex) -> f64 + Sync,
) -> Vec<Stratum> {
    let overlaps = overlaps(frames, options);
    let of_step = |edge: &[f64]| {
        let inside =
            |f: usize, index| near(&frames[f], index, options) && (edge[0]..edge[1]).contains(&value(f, index));
        stratum(edge[0], edge[1], &evidence(frames, &overlaps, options, options.overlap, inside))
    };
    edges.windows(2).collect::<Vec<_>>().into_par_iter().map(of_step).collect()
}

fn overlaps(frames: &[EvalFrame], options: &AnalysisOptions) -> Vec<FrameOverlaps> {
    frames.par_iter().map(|frame| FrameOverlaps::new(frame, options.label_frame)).collect()
}

fn evidence(
    frames: &[EvalFrame],
    overlaps: &[FrameOverlaps],
    options: &AnalysisOptions,
    overlap: f64,
    inside: impl Fn(usize, BoxIndex) -> bool,
) -> Evidence {
    let key = CurveKey { class: &options.class, metric: Metric::ThreeD, overlap, difficulty: Difficulty::All };
    Evidence::new(
        frames
            .iter()
            .zip(overlaps)
            .enumerate()
            .map(|(f, (frame, overlaps))| FrameEvidence::collect((frame, overlaps), &key, |index| inside(f, index))),
    )
}

fn stratum(from: f64, to: f64, evidence: &Evidence) -> Stratum {
    let p = evidence.precisions(None);
    let known = |v: f64| (p.n_gt > 0 && !v.is_nan()).then_some(v);
    Stratum {
        from,
        to,
        n_gt: p.n_gt,
        ap40: known(p.ap40),
        ceiling_ap40: ceiling_ap40(p.n_gt),
        ap_area: known(p.ap_area),
        recall: known(100.0 * p.n_tp as f64 / p.n_gt as f64),
    }
}
