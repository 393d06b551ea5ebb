//! Regions of interest from the predictions of points (OpenPCDet: `RoIHeadTemplate.proposal_layer`). Runs on the host.

use super::box_coder::decode;
use super::config::SuppressionConfig;
use super::point_head::POINT_CODE;
use geometry::{Box3, rotated_nms_first};

/// Regions of one frame, by falling score. If NMS keeps fewer boxes than requested, the rest are boxes without extent,
/// with score 0 and class 1. In training they are easy background, as in the reference.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Proposals {
    /// `[x, y, z, dx, dy, dz, yaw]`, m and rad, LiDAR frame.
    pub boxes: Vec<[f32; 7]>,
    /// Largest logit of the region's point.
    pub scores: Vec<f32>,
    /// Class from 1.
    pub labels: Vec<i32>,
}

/// The class with the highest logit (the first of equal ones) and this logit.
pub fn best_class(logits: &[f32]) -> (usize, f32) {
    let best = (0..logits.len()).fold(0, |best, c| if logits[c] > logits[best] { c } else { best });
    (best, logits[best])
}

/// The box of each point: its code decoded with the mean size of its best class.
///
/// # Shapes
/// `logits`: `[N, classes]`, `codes`: `[N, 8]`; result `[N]`.
pub fn point_boxes(points: &[[f32; 3]], logits: &[f32], codes: &[f32], mean_sizes: &[[f32; 3]]) -> Vec<[f32; 7]> {
    let said = logits.chunks_exact(mean_sizes.len()).zip(codes.as_chunks::<POINT_CODE>().0);
    let boxes = points.iter().zip(said).map(|(&p, (logits, &code))| decode(code, p, mean_sizes[best_class(logits).0]));
    boxes.collect()
}

/// Regions of one frame: the `pre` boxes with the highest logits, class-agnostic rotated NMS, the first `post` of the
/// kept boxes.
///
/// # Shapes
/// `boxes`: `[N]`, `logits`: `[N, classes]`; result: `post` regions.
pub fn proposals(boxes: &[[f32; 7]], logits: &[f32], classes: usize, config: &SuppressionConfig) -> Proposals {
    let best: Vec<(usize, f32)> = logits.chunks_exact(classes).map(best_class).collect();
    let mut order: Vec<usize> = (0..boxes.len()).collect();
    order.sort_by(|&a, &b| best[b].1.total_cmp(&best[a].1)); // stable: equal scores stay ordered by index
    order.truncate(config.pre);
    let solid: Vec<Box3> = order.iter().map(|&i| Box3::from_array(boxes[i].map(f64::from))).collect();
    let scores: Vec<f32> = order.iter().map(|&i| best[i].1).collect();
    let mut found = Proposals::default();
    for kept in rotated_nms_first(&solid, &scores, f64::from(config.iou), config.post) {
        let i = order[kept];
        found.boxes.push(boxes[i]);
        found.scores.push(best[i].1);
        found.labels.push(best[i].0 as i32 + 1);
    }
    found.boxes.resize(config.post, [0.0; 7]);
    found.scores.resize(config.post, 0.0);
    found.labels.resize(config.post, 1);
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn best_first_suppressed_and_filled_up() {
        let at = |x: f32| [x, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0];
        let boxes = [at(0.0), at(0.1), at(20.0), at(40.0)];
        let logits = [0.5, -3.0, 1.0, 0.0, -2.0, 3.0, -9.0, -8.0];
        let found = proposals(&boxes, &logits, 2, &SuppressionConfig { iou: 0.8, pre: 3, post: 4 });
        assert_eq!(found.boxes, [at(20.0), at(0.1), [0.0; 7], [0.0; 7]]);
        assert_eq!((found.scores, found.labels), (vec![3.0, 1.0, 0.0, 0.0], vec![2, 1, 1, 1]));
        let none = proposals(&[], &[], 2, &SuppressionConfig { iou: 0.8, pre: 3, post: 2 });
        assert_eq!(none.boxes, [[0.0; 7]; 2]);
    }

    #[test]
    fn numbers_that_are_none_break_nothing() {
        let nan = [f32::NAN; 7];
        let found = proposals(&[nan, nan], &[f32::NAN, f32::NAN], 1, &SuppressionConfig { iou: 0.8, pre: 9, post: 3 });
        assert_eq!(found.boxes.len(), 3);
        assert_eq!(best_class(&[f32::NAN, 2.0]).0, 0);
    }
}
