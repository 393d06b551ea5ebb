//! Targets of the points (OpenPCDet: `PointHeadBox.assign_targets`).

use super::box_coder::encode;
use super::point_head::POINT_CODE;
use geometry::{Box3, points_in_boxes};

/// The margin of the reference's kernel, m.
const MARGIN_M: f64 = 1e-5;

/// Targets of the points of one frame. N points, K of them in a box.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct PointTargets {
    /// Class from 1, 0 for background, -1 for ignored points. Length N.
    pub labels: Vec<i32>,
    /// Point and ground-truth box of each positive, sorted by point. Length K.
    pub positive: Vec<(usize, usize)>,
    /// Code of its box. Length K.
    pub codes: Vec<[f32; POINT_CODE]>,
}

/// Targets of one frame. A point in several boxes belongs to the first one. A point that is in no box, but in one
/// enlarged by `extra_width_m` in total, is ignored.
///
/// `boxes` are `[x, y, z, dx, dy, dz, yaw, class]`, classes counted from 1 in the order of `mean_sizes`.
pub fn assign(
    points: &[[f32; 3]],
    boxes: &[[f32; 8]],
    mean_sizes: &[[f32; 3]],
    extra_width_m: [f32; 3],
) -> PointTargets {
    let solid = |extra: [f32; 3]| -> Vec<Box3> {
        let enlarged = |b: &[f32; 8]| [b[0], b[1], b[2], b[3] + extra[0], b[4] + extra[1], b[5] + extra[2], b[6]];
        boxes.iter().map(|b| Box3::from_array(enlarged(b).map(f64::from))).collect()
    };
    let mut targets = PointTargets { labels: vec![0; points.len()], ..PointTargets::default() };
    for inside in points_in_boxes(points.as_flattened(), 3, &solid(extra_width_m), MARGIN_M) {
        inside.iter().for_each(|&i| targets.labels[i as usize] = -1);
    }
    let mut box_of = vec![None; points.len()];
    let inside = points_in_boxes(points.as_flattened(), 3, &solid([0.0; 3]), MARGIN_M);
    for (b, inside) in inside.iter().enumerate().rev() {
        inside.iter().for_each(|&i| box_of[i as usize] = Some(b));
    }
    for (i, b) in box_of.iter().enumerate().filter_map(|(i, b)| b.map(|b| (i, b))) {
        let bbox = boxes[b];
        let class = bbox[7] as usize;
        targets.labels[i] = class as i32;
        targets.positive.push((i, b));
        targets.codes.push(encode(std::array::from_fn(|k| bbox[k]), points[i], mean_sizes[class - 1]));
    }
    targets
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn first_box_edge_and_background() {
        let sizes = [[3.9, 1.6, 1.56], [0.8, 0.6, 1.73]];
        let car = [0.0, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0, 1.0];
        let walker = [1.0, 0.0, 0.0, 1.0, 1.0, 2.0, 0.3, 2.0];
        let points = [[1.0, 0.1, 0.0], [1.0, 0.0, 0.9], [2.05, 0.0, 0.0], [5.0, 0.0, 0.0], [-1.9, 0.9, 0.7]];
        let targets = assign(&points, &[car, walker], &sizes, [0.2; 3]);
        assert_eq!(targets.labels, [1, 2, -1, 0, 1]);
        assert_eq!(targets.positive, [(0, 0), (1, 1), (4, 0)]);
        assert_eq!(targets.codes[1][6..], [0.3f32.cos(), 0.3f32.sin()]);
        assert!(assign(&points, &[], &sizes, [0.2; 3]).labels.iter().all(|&l| l == 0));
        assert!(assign(&[], &[car], &sizes, [0.2; 3]).labels.is_empty());
    }
}
