//! Suppression of detections (OpenPCDet: `class_agnostic_nms`).

use geometry::{Box3, rotated_nms_first};

/// A logit below this has a sigmoid below `threshold`, so that it need not be computed: nearly all places of a map.
pub fn far_below(threshold: f32) -> f32 {
    // The sigmoid of large logits is rounded too coarsely for a bound.
    if threshold < 0.99 { (threshold / (1.0 - threshold)).ln() - 0.01 } else { f32::NEG_INFINITY }
}

/// Indices of the boxes `[x, y, z, dx, dy, dz, yaw]` that are kept, by falling score: class-agnostic rotated NMS with
/// the BEV IoU `iou`, at most `most` boxes.
pub fn suppress(boxes: impl Iterator<Item = [f32; 7]>, scores: &[f32], iou: f64, most: usize) -> Vec<usize> {
    let solid: Vec<Box3> = boxes.map(|bbox| Box3::from_array(bbox.map(f64::from))).collect();
    rotated_nms_first(&solid, scores, iou, most)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_logit_far_below_reaches_the_threshold() {
        for threshold in [0.0, 1e-6, 0.01, 0.1, 0.3, 0.5, 0.9, 0.98, 0.99, 1.0] {
            let bound = far_below(threshold);
            let sigmoid = |logit: f32| 1.0 / (1.0 + (-logit).exp());
            for logit in (-4000..4000).map(|i| i as f32 * 0.01).filter(|&logit| logit < bound) {
                assert!(sigmoid(logit) < threshold, "{logit}, {threshold}");
            }
            assert!(bound == f32::NEG_INFINITY || sigmoid(bound + 0.02) > threshold);
        }
    }
}
