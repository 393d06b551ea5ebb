//! Points of a region of interest (Shi et al. 2019, PointRCNN, section 3.3; OpenPCDet: `roipoint_pool3d`).

use crate::{Box3, points_in_boxes};

/// The margin of the reference's kernel, m.
const MARGIN_M: f64 = 1e-5;

/// The points of each region of interest: R regions with S entries each.
#[derive(Clone, Debug, PartialEq)]
pub struct RoiPoints {
    /// Indices of points, region after region, `[R, S]`; 0 in a region without points.
    pub index: Vec<u32>,
    /// Number of distinct points in each region, at most S, `[R]`.
    pub count: Vec<u32>,
}

/// The first `samples` points inside each box, in the order of the points. If there are fewer, they are repeated in the
/// same order.
///
/// # Shapes
/// `points`: `[N * channels]`, x, y, z first, m; `boxes`: `[R]`.
pub fn roi_points(points: &[f32], channels: usize, boxes: &[Box3], samples: usize) -> RoiPoints {
    let inside = points_in_boxes(points, channels, boxes, MARGIN_M);
    let mut found = RoiPoints { index: Vec::with_capacity(boxes.len() * samples), count: Vec::new() };
    for mut members in inside {
        members.truncate(samples);
        found.count.push(members.len() as u32);
        if members.is_empty() {
            members.push(0);
        }
        found.index.extend(members.iter().cycle().take(samples));
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn first_points_repeated_in_turn() {
        let points: Vec<f32> = [0.1, 5.0, 0.2, 0.3].iter().flat_map(|&x| [x, 0.0, 0.0]).collect();
        let at = |x: f64| Box3::from_array([x, 0.0, 0.0, 1.0, 1.0, 1.0, 0.4]);
        let found = roi_points(&points, 3, &[at(0.0), at(5.0), at(9.0), Box3::from_array([0.0; 7])], 5);
        assert_eq!(found.count, [3, 1, 0, 0]);
        assert_eq!(found.index, [0, 2, 3, 0, 2, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
        assert_eq!(roi_points(&points, 3, &[at(0.0)], 2), RoiPoints { index: vec![0, 2], count: vec![2] });
        assert_eq!(roi_points(&[], 4, &[at(0.0)], 2), RoiPoints { index: vec![0, 0], count: vec![0] });
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(1000))]
        #[test]
        fn equals_testing_every_point(
            boxes in prop::collection::vec((prop::array::uniform3(-8.0..8.0f64), prop::array::uniform3(0.0..9.0f64), -7.0..7.0f64), 0..8),
            points in prop::collection::vec(prop::array::uniform3(-9.0f32..9.0), 0..150),
            samples in 1usize..40,
        ) {
            let boxes: Vec<Box3> =
                boxes.iter().map(|&(center, size, yaw_rad)| Box3 { center, size, yaw_rad }).collect();
            let found = roi_points(points.as_flattened(), 3, &boxes, samples);
            for (r, b) in boxes.iter().enumerate() {
                let inside = |p: &[f32; 3]| {
                    let local = b.to_local(p.map(f64::from));
                    (0..3).all(|i| local[i].abs() < b.size[i] / 2.0 + if i < 2 { MARGIN_M } else { 0.0 })
                };
                let members: Vec<u32> =
                    (0..points.len()).filter(|&i| inside(&points[i])).take(samples).map(|i| i as u32).collect();
                prop_assert_eq!(found.count[r] as usize, members.len());
                for (place, &i) in found.index[r * samples..][..samples].iter().enumerate() {
                    let want = if members.is_empty() { 0 } else { members[place % members.len()] };
                    prop_assert_eq!(i, want);
                }
            }
        }
    }
}
