//! Non-maximum suppression of rotated boxes.

use crate::{Box3, overlap::BevRectangle};
use std::{cmp::Ordering, collections::HashMap};

/// Indices of the boxes kept, by falling score, equal scores by index. A box is suppressed if its BEV IoU with a kept
/// box is larger than `iou_threshold`. NaN scores come last.
///
/// Only boxes whose bounding circles can intersect are compared. They are found in a grid whose cells are as large as
/// the largest circle.
pub fn rotated_nms(boxes: &[Box3], scores: &[f32], iou_threshold: f64) -> Vec<usize> {
    rotated_nms_first(boxes, scores, iou_threshold, usize::MAX)
}

/// The first `most` indices of [`rotated_nms`]; the search stops there.
pub fn rotated_nms_first(boxes: &[Box3], scores: &[f32], iou_threshold: f64, most: usize) -> Vec<usize> {
    assert_eq!(boxes.len(), scores.len(), "one score a box");
    let mut order: Vec<usize> = (0..boxes.len()).collect();
    order.sort_by(|&i, &j| falling(scores[i], scores[j]));

    let rectangles: Vec<BevRectangle> = boxes.iter().map(BevRectangle::new).collect();
    let diameter = |b: &Box3| b.size[0].hypot(b.size[1]);
    let widest =
        boxes.iter().zip(&rectangles).filter(|(_, r)| r.area > 0.0).map(|(b, _)| diameter(b)).fold(0.0, f64::max);
    let cell_m = if widest > 0.0 { widest } else { 1.0 };
    let cell = |b: &Box3| [b.center[0], b.center[1]].map(|v| (v / cell_m).floor() as i64);

    let mut kept = Vec::new();
    let mut kept_in_cell: HashMap<[i64; 2], Vec<BevRectangle>> = HashMap::new();
    for i in order {
        if kept.len() == most {
            break;
        }
        let [cx, cy] = cell(&boxes[i]);
        // The box's own cell first: an overlapping box is most likely there.
        let near = [0, -1, 1].into_iter();
        let near =
            near.clone().flat_map(|dx| near.clone().map(move |dy| [cx.saturating_add(dx), cy.saturating_add(dy)]));
        let mut rivals = near.filter_map(|key| kept_in_cell.get(&key));
        if !rivals.any(|cell| cell.iter().any(|rival| overlaps(rival, &rectangles[i], iou_threshold))) {
            kept.push(i);
            kept_in_cell.entry([cx, cy]).or_default().push(rectangles[i]);
        }
    }
    kept
}

/// Whether the IoU is larger than `threshold`. Cheap bounds are tried before exact clipping.
fn overlaps(a: &BevRectangle, b: &BevRectangle, threshold: f64) -> bool {
    let both = a.area + b.area;
    // IoU > t means intersection > t * (area a + area b) / (1 + t). The bound is slightly lower to allow for rounding.
    let least = (threshold / (1.0 + threshold) * both * (1.0 - 1e-9)).max(0.0);
    if a.area.min(b.area) < least {
        return false;
    }
    crate::overlap::over_union(a.intersection_above(b, least), a.area, b.area) > threshold
}

fn falling(a: f32, b: f32) -> Ordering {
    b.partial_cmp(&a).unwrap_or_else(|| a.is_nan().cmp(&b.is_nan()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bev_iou;
    use proptest::prelude::*;

    /// The definition, without any shortcut.
    fn plain_nms(boxes: &[Box3], scores: &[f32], iou_threshold: f64) -> Vec<usize> {
        let mut order: Vec<usize> = (0..boxes.len()).collect();
        order.sort_by(|&i, &j| falling(scores[i], scores[j]));
        let mut kept: Vec<usize> = Vec::new();
        for i in order {
            if kept.iter().all(|&k| bev_iou(&boxes[k], &boxes[i]) <= iou_threshold) {
                kept.push(i);
            }
        }
        kept
    }

    #[test]
    fn ties_by_index_and_nan_last() {
        let far = |i: usize| Box3::from_array([10.0 * i as f64, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0]);
        let boxes: Vec<Box3> = (0..5).map(far).collect();
        assert_eq!(rotated_nms(&boxes, &[0.5, f32::NAN, 0.9, 0.5, 0.9], 0.1), [2, 4, 0, 3, 1]);
        assert_eq!(rotated_nms(&[], &[], 0.1), Vec::<usize>::new());
        let same = vec![far(0); 4];
        assert_eq!(rotated_nms(&same, &[0.1, 0.3, 0.3, 0.2], 0.99), [1]);
    }

    #[test]
    fn boxes_without_extent_suppress_nothing() {
        let flat = Box3::from_array([0.0; 7]);
        let nan = Box3::from_array([f64::NAN; 7]);
        assert_eq!(rotated_nms(&[flat, flat, nan, nan], &[1.0; 4], 0.0), [0, 1, 2, 3]);
    }

    proptest! {
        #[test]
        fn equals_the_definition(
            values in prop::collection::vec((-12.0..12.0f64, -12.0..12.0f64, 0.0..6.0f64, 0.0..3.0f64, -7.0..7.0f64, 0u8..20), 0..120),
            threshold in prop_oneof![Just(0.0), Just(0.01), 0.0..1.0f64],
        ) {
            let boxes: Vec<Box3> =
                values.iter().map(|v| Box3::from_array([v.0, v.1, 0.0, v.2, v.3, 1.0, v.4])).collect();
            let scores: Vec<f32> = values.iter().map(|v| f32::from(v.5)).collect();
            let plain = plain_nms(&boxes, &scores, threshold);
            prop_assert_eq!(&rotated_nms(&boxes, &scores, threshold), &plain);
            for most in [0, 1, 7] {
                prop_assert_eq!(&rotated_nms_first(&boxes, &scores, threshold, most), &plain[..most.min(plain.len())]);
            }
        }
    }
}
