//! Suppression of detections (OpenPCDet: `class_agnostic_nms`).

use geometry::{Box3, rotated_nms_first};

/// Indices of the boxes `[x, y, z, dx, dy, dz, yaw]` that are kept, by falling score: class-agnostic rotated NMS with
/// the BEV IoU `iou`, at most `most` boxes.
pub fn suppress(boxes: impl Iterator<Item = [f32; 7]>, scores: &[f32], iou: f64, most: usize) -> Vec<usize> {
    let solid: Vec<Box3> = boxes.map(|bbox| Box3::from_array(bbox.map(f64::from))).collect();
    rotated_nms_first(&solid, scores, iou, most)
}
