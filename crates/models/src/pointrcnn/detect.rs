//! Detections of a batch (OpenPCDet: `generate_predicted_boxes`, `post_processing`).

use super::config::RcnnDetectionConfig;
use super::network::PointRcnn;
use super::proposals::{point_boxes, proposals};
use super::roi_input::{RoiInput, Scene};
use super::sample::{Preparation, Sample};
use super::training::point_scores;
use crate::layers::{Mode, host};
use crate::pointpillars::box_coder::decode;
use crate::{ModelError, Prediction};
use data::Detection;
use geometry::{Box3, rotated_nms_first};
use rayon::prelude::*;

/// Boxes of each sample, by falling score, and all refined regions.
///
/// # Errors
/// Scores or boxes that are not finite.
pub fn detections(
    network: &PointRcnn,
    batch: &[&Sample],
    preparation: &Preparation,
) -> Result<Vec<Prediction>, ModelError> {
    let seen: Vec<&Sample> = batch.iter().copied().filter(|s| !s.points.is_empty()).collect();
    if seen.is_empty() {
        return Ok(vec![Prediction::default(); batch.len()]);
    }
    let (net, classes) = (&preparation.net, preparation.mean_sizes.len());
    let stages = network.points(&seen, Mode::Eval);
    let (logits, codes) = (host(stages.predictions.cls.clone())?, host(stages.predictions.boxes.clone())?);
    let first_rows = seen.iter().scan(0, |rows, sample| {
        let first = *rows;
        *rows += sample.points.len();
        Some(first)
    });
    let first_rows: Vec<usize> = first_rows.collect();
    let of_frame = |f: usize| {
        let (points, first) = (&seen[f].points, first_rows[f]);
        let logits = &logits[first * classes..][..points.len() * classes];
        let codes = &codes[first * super::POINT_CODE..][..points.len() * super::POINT_CODE];
        if !logits.iter().chain(codes).all(|v| v.is_finite()) {
            return Err(not_finite(&seen[f].id));
        }
        let boxes = point_boxes(points, logits, codes, &preparation.mean_sizes);
        let found = proposals(&boxes, logits, classes, &net.proposals.test);
        let scores = point_scores(logits, classes);
        let scene = Scene { points, scores: &scores, first_row: first as u32 };
        let input = RoiInput::new(scene, &found.boxes, &net.roi_head);
        Ok((found, input))
    };
    let frames: Vec<_> = (0..seen.len()).into_par_iter().map(of_frame).collect();
    let (mut regions, mut input) = (Vec::new(), RoiInput::empty(&net.roi_head));
    for frame in frames {
        let (found, own) = frame?;
        input.append(&own);
        regions.push(found);
    }
    let roi = network.roi_head.forward(stages.point_features(), &input, Mode::Eval);
    let (cls, reg) = (host(roi.cls)?, host(roi.reg)?);
    let mut found = Vec::new();
    let mut first = 0;
    for (sample, regions) in seen.iter().zip(&regions) {
        let count = regions.boxes.len();
        let (cls, reg) = (&cls[first..first + count], &reg[first * 7..(first + count) * 7]);
        first += count;
        if !cls.iter().chain(reg).all(|v| v.is_finite()) {
            return Err(not_finite(&sample.id));
        }
        let boxes = final_boxes(&regions.boxes, reg);
        let of = |&(i, score): &(usize, f32)| Detection {
            class: preparation.classes[regions.labels[i] as usize - 1].clone(),
            bbox: Box3::from_array(boxes[i].map(f64::from)),
            score,
        };
        // Sizes are exponentials, which may overflow early in training. Such boxes are dropped.
        let is_number = |&(i, _): &(usize, f32)| boxes[i].iter().all(|v| v.is_finite());
        let kept = suppress(&boxes, cls, &net.detection);
        let all = cls.iter().map(|&logit| sigmoid(logit)).enumerate();
        found.push(Prediction {
            detections: kept.iter().filter(|kept| is_number(kept)).map(of).collect(),
            regions: all.filter(is_number).map(|region| of(&region)).collect(),
        });
    }
    let mut found = found.into_iter();
    let of_sample =
        |s: &&Sample| if s.points.is_empty() { Prediction::default() } else { found.next().unwrap_or_default() };
    Ok(batch.iter().map(of_sample).collect())
}

fn not_finite(id: &str) -> ModelError {
    ModelError::NonFinite(format!(
        "frame {id}: the network gives scores or boxes that are not numbers; its weights are damaged or its training diverged"
    ))
}

fn sigmoid(logit: f32) -> f32 {
    1.0 / (1.0 + (-logit).exp())
}

/// The refined box of each region.
///
/// # Shapes
/// `reg`: `[R, 7]`; result `[R]`.
pub fn final_boxes(rois: &[[f32; 7]], reg: &[f32]) -> Vec<[f32; 7]> {
    let refined = |(roi, &residual): (&[f32; 7], &[f32; 7])| {
        let local = decode(residual, [0.0, 0.0, 0.0, roi[3], roi[4], roi[5], roi[6]]);
        let (sin, cos) = roi[6].sin_cos();
        let [x, y, z, ..] = local;
        let (x, y) = (x * cos - y * sin + roi[0], x * sin + y * cos + roi[1]);
        [x, y, z + roi[2], local[3], local[4], local[5], local[6]]
    };
    rois.iter().zip(reg.as_chunks::<7>().0).map(refined).collect()
}

/// Indices and scores of the regions kept, by falling score: sigmoid, score threshold, the `pre` best, class-agnostic
/// rotated NMS, the first `post`.
pub fn suppress(boxes: &[[f32; 7]], logits: &[f32], config: &RcnnDetectionConfig) -> Vec<(usize, f32)> {
    let scores = logits.iter().map(|&logit| sigmoid(logit));
    let mut best: Vec<(usize, f32)> = scores.enumerate().filter(|(_, s)| *s >= config.score_threshold).collect();
    best.sort_by(|a, b| b.1.total_cmp(&a.1)); // stable: equal scores stay ordered by region
    best.truncate(config.suppression.pre);
    let solid: Vec<Box3> = best.iter().map(|&(i, _)| Box3::from_array(boxes[i].map(f64::from))).collect();
    let scores: Vec<f32> = best.iter().map(|&(_, score)| score).collect();
    let kept = rotated_nms_first(&solid, &scores, f64::from(config.suppression.iou), config.suppression.post);
    kept.into_iter().map(|k| best[k]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn residuals_are_in_the_region_frame() {
        let roi = [10.0, 5.0, -1.0, 4.0, 3.0, 1.5, std::f32::consts::FRAC_PI_2];
        let found = final_boxes(&[roi], &[0.2, 0.0, 0.1, 0.0, 0.0, 0.0, 0.1]);
        let want = [10.0, 6.0, -0.85, 4.0, 3.0, 1.5, std::f32::consts::FRAC_PI_2 + 0.1];
        assert!(found[0].iter().zip(want).all(|(a, b)| (a - b).abs() < 1e-5), "{found:?}");
    }

    #[test]
    fn threshold_order_and_suppression() {
        let at = |x: f32| [x, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0];
        let boxes = [at(0.0), at(0.5), at(20.0), at(40.0)];
        let kept = suppress(&boxes, &[1.0, 2.0, 0.0, -9.0], &RcnnDetectionConfig::default());
        assert_eq!(kept.iter().map(|k| k.0).collect::<Vec<_>>(), [1, 2]);
        assert_eq!(kept[1].1, 0.5);
    }
}
