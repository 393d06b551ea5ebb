//! Decoding of a head's outputs to boxes (OpenPCDet: `decode_bbox_from_heatmap`, `class_agnostic_nms`).

use super::box_coder::{CenterGrid, Code};
use crate::bev::{far_below, suppress};
use rayon::prelude::*;

/// Cells a task.
const CELLS_A_TASK: usize = 8192;

/// Score threshold, limits and NMS.
#[derive(Clone, Debug, PartialEq)]
pub struct DecodeOptions {
    /// Cells with the highest scores over all classes of a head that become boxes.
    pub max_boxes: usize,
    /// A detection's score is above this.
    pub score_threshold: f32,
    /// `[x_min, y_min, z_min, x_max, y_max, z_max]` of the centres, m, LiDAR frame, bounds included.
    pub center_range_m: [f32; 6],
    /// BEV IoU above which the box with the lower score is suppressed, regardless of their classes.
    pub nms_iou: f64,
    /// Boxes with the highest scores that enter the NMS.
    pub nms_pre: usize,
    /// Largest number of boxes kept.
    pub nms_post: usize,
}

/// A detected box.
#[derive(Clone, Debug, PartialEq)]
pub struct CenterBox {
    /// Class of the head, counted from 0.
    pub class: usize,
    /// `[x, y, z, dx, dy, dz, yaw]`, m and rad, LiDAR frame.
    pub bbox: [f32; 7],
    /// Sigmoid of the class's logit at its cell.
    pub score: f32,
}

/// An output of the network that is not finite.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("cell {cell}: the network's {output} is not finite")]
pub struct NonFinite {
    /// The first such cell.
    pub cell: usize,
    /// Which of the head's outputs.
    pub output: &'static str,
}

/// Raw outputs of one head for one frame on the host, each `[channels, rows, columns]`.
#[derive(Clone, Copy, Debug)]
pub struct HeadValues<'a> {
    /// Logits of the heat maps.
    pub hm: &'a [f32],
    /// Branches of the box code in its order: offset (2), z (1), logarithms of the sizes (3), cosine and sine (2).
    pub code: [&'a [f32]; 4],
}

impl HeadValues<'_> {
    /// The box code at a cell of a map of `cells` cells.
    fn code(&self, cell: usize, cells: usize) -> Code {
        let mut code = [0.0; 8];
        let values = self.code.iter().flat_map(|branch| branch.iter().skip(cell).step_by(cells.max(1)));
        code.iter_mut().zip(values).for_each(|(to, &value)| *to = value);
        code
    }
}

/// The boxes of the best cells before suppression, by falling score, equal scores by class and cell. Neighbouring cells
/// may give boxes of the same object.
///
/// # Errors
/// A score that is NaN or infinite at any cell, or such a box among the best.
pub fn best_boxes(
    values: HeadValues<'_>,
    grid: &CenterGrid,
    options: &DecodeOptions,
) -> Result<Vec<CenterBox>, NonFinite> {
    let cells = grid.cells();
    let far_below = far_below(options.score_threshold);
    let of_task = |(task, logits): (usize, &[f32])| {
        let mut best = Vec::new();
        for (place, &logit) in (task * CELLS_A_TASK..).zip(logits) {
            if !logit.is_finite() {
                return Err(NonFinite { cell: place % cells, output: "heat map" });
            }
            let score = if logit < far_below { 0.0 } else { 1.0 / (1.0 + (-logit).exp()) };
            if score > options.score_threshold {
                best.push((place, score));
            }
        }
        Ok(best)
    };
    let tasks: Vec<_> = values.hm.par_chunks(CELLS_A_TASK).enumerate().map(of_task).collect();
    let mut best: Vec<(usize, f32)> = Vec::new();
    for task in tasks {
        best.extend(task?);
    }
    best.sort_by(|a, b| b.1.total_cmp(&a.1)); // stable: equal scores stay ordered by class and cell
    best.truncate(options.max_boxes);
    let mut found = Vec::with_capacity(best.len());
    for (place, score) in best {
        let (class, cell) = (place / cells, place % cells);
        let code = values.code(cell, cells);
        if !code.iter().all(|v| v.is_finite()) {
            return Err(NonFinite { cell, output: "box" });
        }
        let bbox = grid.decode(cell, code);
        let range = &options.center_range_m;
        let inside = (0..3).all(|i| bbox[i] >= range[i] && bbox[i] <= range[i + 3]);
        // Sizes are exponentials, which may overflow early in training. Such boxes are dropped.
        if inside && bbox.iter().all(|v| v.is_finite()) {
            found.push(CenterBox { class, bbox, score });
        }
    }
    Ok(found)
}

/// The boxes that remain after class-agnostic rotated NMS, by falling score.
pub fn suppressed(mut found: Vec<CenterBox>, options: &DecodeOptions) -> Vec<CenterBox> {
    found.truncate(options.nms_pre);
    let scores: Vec<f32> = found.iter().map(|b| b.score).collect();
    let kept = suppress(found.iter().map(|b| b.bbox), &scores, options.nms_iou, options.nms_post);
    kept.into_iter().map(|i| found[i].clone()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const CELLS: usize = 12;

    fn grid() -> CenterGrid {
        CenterGrid { origin_m: [0.0, -6.0], pillar_m: [4.0, 4.0], stride: 1, map: [3, 4] }
    }

    fn options() -> DecodeOptions {
        DecodeOptions {
            max_boxes: 10,
            score_threshold: 0.3,
            center_range_m: [0.0, -6.0, -5.0, 16.0, 6.0, 5.0],
            nms_iou: 0.2,
            nms_pre: 100,
            nms_post: 100,
        }
    }

    /// Heat maps of two classes and branches with the codes of `boxes`.
    fn outputs(boxes: &[([f32; 7], usize, f32)]) -> (Vec<f32>, [Vec<f32>; 4]) {
        let mut hm = vec![-9.0; 2 * CELLS];
        let mut code = [2, 1, 3, 2].map(|channels| vec![0.0; channels * CELLS]);
        for &(bbox, class, logit) in boxes {
            let (cell, values) = grid().encode(bbox);
            hm[class * CELLS + cell] = logit;
            let mut values = values.into_iter();
            for branch in &mut code {
                for channel in branch.chunks_exact_mut(CELLS) {
                    channel[cell] = values.next().unwrap();
                }
            }
        }
        (hm, code)
    }

    fn found(hm: &[f32], code: &[Vec<f32>; 4], options: &DecodeOptions) -> Result<Vec<CenterBox>, NonFinite> {
        best_boxes(HeadValues { hm, code: code.each_ref().map(|v| &v[..]) }, &grid(), options)
    }

    const NEAR: [f32; 7] = [2.5, -3.0, -1.0, 3.9, 1.6, 1.5, 0.4];
    const FAR: [f32; 7] = [13.0, 3.5, -0.5, 4.5, 1.8, 1.6, -3.0];

    #[test]
    fn boxes_come_back_by_falling_score() {
        let (hm, code) = outputs(&[(NEAR, 0, 0.5), (FAR, 1, 2.0)]);
        let boxes = found(&hm, &code, &options()).unwrap();
        assert_eq!(boxes.iter().map(|b| b.class).collect::<Vec<_>>(), [1, 0]);
        for (found, want) in boxes.iter().zip([FAR, NEAR]) {
            assert!((0..7).all(|i| (found.bbox[i] - want[i]).abs() < 1e-5), "{found:?} {want:?}");
        }
        assert!((boxes[0].score - 0.880797).abs() < 1e-6);
    }

    #[test]
    fn limits() {
        let (hm, code) = outputs(&[(NEAR, 0, 0.5), (FAR, 1, 2.0)]);
        let count = |options: DecodeOptions| found(&hm, &code, &options).unwrap().len();
        assert_eq!(count(options()), 2);
        assert_eq!(count(DecodeOptions { max_boxes: 1, ..options() }), 1);
        assert_eq!(count(DecodeOptions { score_threshold: 0.7, ..options() }), 1);
        assert_eq!(count(DecodeOptions { score_threshold: 0.9, ..options() }), 0);
        assert_eq!(count(DecodeOptions { center_range_m: [0.0, -6.0, -5.0, 12.0, 6.0, 5.0], ..options() }), 1);
        let (hm, code) = outputs(&[(NEAR, 0, 0.0)]);
        let at_the_threshold = DecodeOptions { score_threshold: 0.5, ..options() };
        assert!(found(&hm, &code, &at_the_threshold).unwrap().is_empty(), "a score must be above the threshold");
    }

    #[test]
    fn neighbours_of_the_same_object_are_suppressed() {
        let beside = [4.2, -3.0, -1.0, 3.9, 1.6, 1.5, 0.4];
        let (hm, code) = outputs(&[(NEAR, 0, 2.0), (beside, 1, 1.0), (FAR, 1, 0.5)]);
        let all = found(&hm, &code, &options()).unwrap();
        assert_eq!(all.len(), 3);
        let scores = |options: DecodeOptions| -> Vec<usize> {
            suppressed(all.clone(), &options).iter().map(|b| b.class).collect()
        };
        assert_eq!(scores(options()), [0, 1]);
        assert_eq!(scores(DecodeOptions { nms_iou: 0.9, ..options() }), [0, 1, 1]);
        assert_eq!(scores(DecodeOptions { nms_post: 1, ..options() }), [0]);
        assert_eq!(scores(DecodeOptions { nms_pre: 2, ..options() }), [0]);
    }

    #[test]
    fn outputs_that_are_not_finite() {
        let (mut hm, mut code) = outputs(&[(NEAR, 0, 2.0), (FAR, 1, 0.5)]);
        let cell = grid().encode(NEAR).0;
        code[2][cell] = 200.0; // its exponential overflows
        assert_eq!(found(&hm, &code, &options()).unwrap().len(), 1);
        code[2][cell] = f32::NAN;
        assert_eq!(found(&hm, &code, &options()), Err(NonFinite { cell, output: "box" }));
        hm[CELLS + 7] = f32::INFINITY;
        assert_eq!(found(&hm, &code, &options()), Err(NonFinite { cell: 7, output: "heat map" }));
    }
}
