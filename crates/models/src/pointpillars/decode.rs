//! Decoding of the head's outputs to boxes (OpenPCDet: `generate_predicted_boxes`, `post_processing`,
//! `class_agnostic_nms`).

use super::box_coder;
use crate::bev::{far_below, suppress};
use rayon::prelude::*;

/// Anchors a task.
const ANCHORS: usize = 8192;

/// Score threshold, NMS and direction constants.
#[derive(Clone, Debug, PartialEq)]
pub struct DecodeOptions {
    /// Lowest score of a detection.
    pub score_threshold: f32,
    /// BEV IoU above which the box with the lower score is suppressed, regardless of their classes.
    pub nms_iou: f64,
    /// Boxes with the highest scores that enter the NMS.
    pub nms_pre: usize,
    /// Largest number of boxes kept.
    pub nms_post: usize,
    /// Start of the first direction bin, rad.
    pub dir_offset: f32,
    /// Offset of the period into which the regressed heading is wrapped.
    pub dir_limit_offset: f32,
}

/// A detected box with a class index.
#[derive(Clone, Debug, PartialEq)]
pub struct RawBox {
    /// Index of its anchor.
    pub anchor: usize,
    /// Class counted from 0.
    pub class: usize,
    /// `[x, y, z, dx, dy, dz, yaw]`, m and rad, LiDAR frame.
    pub bbox: [f32; 7],
    /// Sigmoid of the class's logit.
    pub score: f32,
}

/// An output of the network that is not finite.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("anchor {anchor}: the network's {output} is not finite")]
pub struct NonFinite {
    /// The first such anchor.
    pub anchor: usize,
    /// Which of the head's outputs.
    pub output: &'static str,
}

/// Detections of one frame by falling score, equal scores by anchor.
///
/// Each anchor gets the class with the highest score (the first of equal ones). Then follow score threshold, selection
/// of the `nms_pre` best, class-agnostic rotated NMS, and selection of the first `nms_post`.
///
/// # Shapes
/// `cls` `[A, classes]`, `boxes` `[A, 7]`, `dir` `[A, bins]`, all raw outputs.
///
/// # Errors
/// A score that is NaN or infinite at any anchor, or such a box or direction output among the boxes that enter the NMS.
pub fn decode(
    cls: &[f32],
    boxes: &[f32],
    dir: &[f32],
    anchors: &[[f32; 7]],
    options: &DecodeOptions,
) -> Result<Vec<RawBox>, NonFinite> {
    if anchors.is_empty() {
        return Ok(Vec::new());
    }
    let (classes, bins) = (cls.len() / anchors.len(), dir.len() / anchors.len());
    assert_eq!((cls.len(), boxes.len()), (anchors.len() * classes, anchors.len() * 7), "one prediction per anchor");
    let of_task = |(task, cls): (usize, &[f32])| best_anchors(cls, task * ANCHORS, classes, options.score_threshold);
    let tasks: Vec<_> = cls.par_chunks(ANCHORS * classes).enumerate().map(of_task).collect();
    let mut best: Vec<(usize, f32)> = Vec::new();
    for task in tasks {
        best.extend(task?);
    }
    best.sort_by(|a, b| b.1.total_cmp(&a.1)); // stable: equal scores stay ordered by anchor
    best.truncate(options.nms_pre);

    let mut found = Vec::with_capacity(best.len());
    for &(anchor, score) in &best {
        let logits = &cls[anchor * classes..][..classes];
        let (residual, direction) = (&boxes[anchor * 7..][..7], &dir[anchor * bins..][..bins]);
        if !residual.iter().chain(direction).all(|v| v.is_finite()) {
            return Err(NonFinite { anchor, output: "box" });
        }
        let bbox = decode_box(residual, direction, anchors[anchor], options);
        // Sizes are exponentials, which may overflow early in training. Such boxes are dropped.
        if !bbox.iter().all(|v| v.is_finite()) {
            continue;
        }
        // Different logits may give equal scores; then the first class is taken, as in the reference.
        let class = logits.iter().position(|&logit| sigmoid(logit) == score).unwrap_or(0);
        found.push(RawBox { anchor, class, bbox, score });
    }
    let scores: Vec<f32> = found.iter().map(|raw| raw.score).collect();
    let kept = suppress(found.iter().map(|raw| raw.bbox), &scores, options.nms_iou, options.nms_post);
    Ok(kept.into_iter().map(|i| found[i].clone()).collect())
}

/// The anchors from `first` on whose best score reaches the threshold, with this score.
fn best_anchors(cls: &[f32], first: usize, classes: usize, threshold: f32) -> Result<Vec<(usize, f32)>, NonFinite> {
    let far_below = far_below(threshold);
    let mut best = Vec::new();
    for (i, logits) in cls.chunks_exact(classes).enumerate() {
        let anchor = first + i;
        if logits.iter().any(|logit| !logit.is_finite()) {
            return Err(NonFinite { anchor, output: "class score" });
        }
        let most = logits.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        if most < far_below {
            continue;
        }
        let score = sigmoid(most);
        if score >= threshold {
            best.push((anchor, score));
        }
    }
    Ok(best)
}

/// The box of every anchor, before any threshold.
///
/// # Shapes
/// `boxes` `[A, 7]`, `dir` `[A, bins]` -> `[A, 7]`, m and rad, LiDAR frame.
pub fn decode_boxes(boxes: &[f32], dir: &[f32], anchors: &[[f32; 7]], options: &DecodeOptions) -> Vec<[f32; 7]> {
    let bins = dir.len() / anchors.len().max(1);
    let outputs = boxes.chunks_exact(7).zip(dir.chunks_exact(bins.max(1)));
    anchors.iter().zip(outputs).map(|(&anchor, (residual, dir))| decode_box(residual, dir, anchor, options)).collect()
}

fn decode_box(residual: &[f32], direction: &[f32], anchor: [f32; 7], options: &DecodeOptions) -> [f32; 7] {
    let mut bbox = box_coder::decode(std::array::from_fn(|i| residual[i]), anchor);
    let bins = direction.len();
    let bin = (0..bins).fold(0, |best, i| if direction[i] > direction[best] { i } else { best });
    bbox[6] = box_coder::direction_decode(bbox[6], bin, options.dir_offset, options.dir_limit_offset, bins);
    bbox
}

fn sigmoid(logit: f32) -> f32 {
    1.0 / (1.0 + (-logit).exp())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn options() -> DecodeOptions {
        DecodeOptions {
            score_threshold: 0.1,
            nms_iou: 0.01,
            nms_pre: 4096,
            nms_post: 500,
            dir_offset: box_coder::DIRECTION_OFFSET_RAD,
            dir_limit_offset: 0.0,
        }
    }

    /// Anchors apart from each other, residuals zero, direction bin 1 (for yaw 0: forward).
    fn outputs(count: usize) -> (Vec<f32>, Vec<f32>, Vec<[f32; 7]>) {
        let anchors = (0..count).map(|i| [10.0 * i as f32, 0.0, 0.0, 3.9, 1.6, 1.5, 0.0]).collect();
        (vec![0.0; count * 7], [0.0, 1.0].repeat(count), anchors)
    }

    #[test]
    fn best_class_threshold_and_order() {
        let (boxes, dir, anchors) = outputs(4);
        let cls = [-1.0, 0.5, 2.0, 2.0, -9.0, -9.0, -1.0, 0.5];
        let found = decode(&cls, &boxes, &dir, &anchors, &options()).unwrap();
        let short: Vec<(usize, usize)> = found.iter().map(|raw| (raw.anchor, raw.class)).collect();
        assert_eq!(short, [(1, 0), (0, 1), (3, 1)]);
        assert!((found[0].score - 0.880797).abs() < 1e-6);
        assert!((found[0].bbox[6] - std::f32::consts::TAU).abs() < 1e-5, "yaw 0 up to a turn: {:?}", found[0].bbox);
    }

    #[test]
    fn caps_and_suppression() {
        let (boxes, dir, mut anchors) = outputs(4);
        anchors[1][0] = 0.5; // overlaps the first
        let cls = [3.0, 2.0, 1.0, 0.0];
        let of = |options: DecodeOptions| -> Vec<usize> {
            let found = decode(&cls, &boxes, &dir, &anchors, &options).unwrap();
            found.iter().map(|raw| raw.anchor).collect()
        };
        assert_eq!(of(options()), [0, 2, 3]);
        assert_eq!(of(DecodeOptions { nms_post: 2, ..options() }), [0, 2]);
        assert_eq!(of(DecodeOptions { nms_pre: 2, ..options() }), [0]);
        assert_eq!(of(DecodeOptions { score_threshold: 0.999, ..options() }), [0usize; 0]);
        assert_eq!(decode(&[], &[], &[], &[], &options()), Ok(vec![]));
    }

    #[test]
    fn boxes_of_infinite_size_are_dropped() {
        let (mut boxes, dir, anchors) = outputs(2);
        boxes[7 + 3] = 200.0; // its exponential overflows
        let found = decode(&[2.0, 3.0], &boxes, &dir, &anchors, &options()).unwrap();
        assert_eq!(found.iter().map(|raw| raw.anchor).collect::<Vec<_>>(), [0]);
    }

    #[test]
    fn outputs_that_are_not_finite_are_an_error() {
        let (boxes, dir, anchors) = outputs(2);
        let of = |cls: [f32; 2], boxes: &[f32], dir: &[f32]| decode(&cls, boxes, dir, &anchors, &options());
        assert_eq!(of([-5.0, f32::NAN], &boxes, &dir), Err(NonFinite { anchor: 1, output: "class score" }));
        assert!(of([f32::INFINITY, 0.0], &boxes, &dir).is_err());
        let mut broken = boxes.clone();
        broken[7 + 3] = f32::NAN;
        assert_eq!(of([0.0, 0.0], &broken, &dir), Err(NonFinite { anchor: 1, output: "box" }));
        assert!(of([0.0, -9.0], &broken, &dir).is_ok(), "boxes below the threshold are not checked");
        assert!(of([0.0, 0.0], &boxes, &[0.0, f32::NAN, 0.0, 0.0]).is_err());
    }
}
