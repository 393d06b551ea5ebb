//! Targets of the anchors (OpenPCDet: `AxisAlignedTargetAssigner`).
//!
//! Each class is assigned separately: its anchors against its ground-truth boxes, by the BEV IoU of boxes rotated to
//! the nearest axis. The reference computes the full IoU matrix. Here only anchors near a box are visited, which is
//! equivalent because all others have IoU 0. All in f32, in the reference's order of operations.

use super::anchors::{AnchorClass, anchors_per_cell};
use super::box_coder::{DIRECTION_BINS, direction_target, encode, limit_period};
use std::f32::consts::{FRAC_PI_4, PI};

/// Margin of the search for overlapping anchors, which allows for rounding, m.
const REACH_MARGIN_M: f32 = 0.01;

/// Targets of the anchors of one frame. A anchors, K of them positive.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct Targets {
    /// Class from 1, 0 for background, -1 for ignored anchors. Length A.
    pub labels: Vec<i32>,
    /// Anchor and ground-truth box of each positive, sorted by anchor. Length K.
    pub positive: Vec<(usize, usize)>,
    /// Box residual of each positive. Length K.
    pub reg: Vec<[f32; 7]>,
    /// Direction bin of each positive. Length K.
    pub dir: Vec<usize>,
}

/// Targets of one frame.
///
/// `boxes` are `[x, y, z, dx, dy, dz, yaw, class]`, classes counted from 1 in the order of `classes`; others are
/// ignored. `anchors` are those of [`super::anchors::anchors`] on a feature map of `[height, width]`. An anchor is
/// 1. positive if it has the highest IoU above 0 of its class with some box (ties included); its target is the box with
///    which its own IoU is highest;
/// 2. else background if its highest IoU is below `unmatched`;
/// 3. else positive if its highest IoU is at least `matched`;
/// 4. else ignored.
///
/// If an anchor has the same IoU with several boxes, the first one is its target.
pub fn assign(
    anchors: &[[f32; 7]],
    classes: &[AnchorClass],
    map: [usize; 2],
    boxes: &[[f32; 8]],
    dir_offset_rad: f32,
) -> Targets {
    let [height, width] = map;
    let per_cell = anchors_per_cell(classes);
    assert_eq!(anchors.len(), height * width * per_cell, "anchors of a map of {height} x {width}");
    let mut labels = vec![0; anchors.len()];
    let mut positive = Vec::new();
    let grid = AnchorGrid {
        anchors,
        per_cell,
        xs: (0..width).map(|column| anchors[column * per_cell][0]).collect(),
        ys: (0..height).map(|row| anchors[row * width * per_cell][1]).collect(),
    };
    let mut slot = 0;
    for (c, class) in classes.iter().enumerate() {
        let slots = slot..slot + class.rotations.len();
        slot = slots.end;
        let mut overlaps: Vec<Overlap> = Vec::new();
        for (truth, bbox) in boxes.iter().enumerate().filter(|(_, bbox)| bbox[7] == (c + 1) as f32) {
            let bbox = NearestBev::new(bbox);
            slots.clone().for_each(|slot| grid.overlaps(slot, truth, &bbox, &mut overlaps));
        }
        overlaps.sort_unstable_by_key(|o| (o.anchor, o.truth));
        let mut most_of = vec![0.0f32; boxes.len()];
        overlaps.iter().for_each(|o| most_of[o.truth] = most_of[o.truth].max(o.iou));
        for of_anchor in overlaps.chunk_by(|a, b| a.anchor == b.anchor) {
            let best = of_anchor.iter().fold(&of_anchor[0], |best, o| if o.iou > best.iou { o } else { best });
            let forced = of_anchor.iter().any(|o| o.iou == most_of[o.truth]);
            labels[best.anchor] = if forced {
                c as i32 + 1
            } else if best.iou < class.unmatched {
                0
            } else if best.iou >= class.matched {
                c as i32 + 1
            } else {
                -1
            };
            if labels[best.anchor] > 0 {
                positive.push((best.anchor, best.truth));
            }
        }
    }
    positive.sort_unstable();
    let box_of = |truth: usize| std::array::from_fn(|i| boxes[truth][i]);
    let reg: Vec<[f32; 7]> = positive.iter().map(|&(anchor, truth)| encode(box_of(truth), anchors[anchor])).collect();
    // The reference recomputes the heading from the residual, including rounding.
    let dir = positive
        .iter()
        .zip(&reg)
        .map(|(&(anchor, _), reg)| direction_target(reg[6] + anchors[anchor][6], dir_offset_rad, DIRECTION_BINS));
    let dir = dir.collect();
    Targets { labels, positive, reg, dir }
}

/// A ground-truth box that overlaps an anchor.
struct Overlap {
    anchor: usize,
    truth: usize,
    /// IoU, above zero.
    iou: f32,
}

/// Anchors on their regular grid.
struct AnchorGrid<'a> {
    anchors: &'a [[f32; 7]],
    per_cell: usize,
    /// Position of each column, ascending, m.
    xs: Vec<f32>,
    /// Position of each row, ascending, m.
    ys: Vec<f32>,
}

impl AnchorGrid<'_> {
    /// Adds the anchors of one slot of the cells (one class and rotation, hence one size) that overlap a box.
    fn overlaps(&self, slot: usize, truth: usize, bbox: &NearestBev, found: &mut Vec<Overlap>) {
        let anchor = NearestBev::new(&self.anchors[slot]);
        let near = |positions: &[f32], axis: usize| {
            let reach = (anchor.max[axis] - anchor.min[axis]) / 2.0 + REACH_MARGIN_M;
            let from = positions.partition_point(|&p| p < bbox.min[axis] - reach);
            let to = positions.partition_point(|&p| p <= bbox.max[axis] + reach);
            from..to.max(from)
        };
        let columns = near(&self.xs, 0);
        for row in near(&self.ys, 1) {
            for column in columns.clone() {
                let anchor = (row * self.xs.len() + column) * self.per_cell + slot;
                let iou = NearestBev::new(&self.anchors[anchor]).iou(bbox);
                if iou > 0.0 {
                    found.push(Overlap { anchor, truth, iou });
                }
            }
        }
    }
}

/// The BEV rectangle of a box rotated to the nearest axis, m.
#[derive(Clone, Copy, Debug)]
pub struct NearestBev {
    /// Lowest x and y.
    pub min: [f32; 2],
    /// Highest x and y.
    pub max: [f32; 2],
}

impl NearestBev {
    /// From `[x, y, z, dx, dy, dz, yaw, ..]`.
    pub fn new(bbox: &[f32]) -> Self {
        let turned = limit_period(bbox[6], 0.5, PI).abs() >= FRAC_PI_4;
        let [dx, dy] = if turned { [bbox[4], bbox[3]] } else { [bbox[3], bbox[4]] };
        NearestBev { min: [bbox[0] - dx / 2.0, bbox[1] - dy / 2.0], max: [bbox[0] + dx / 2.0, bbox[1] + dy / 2.0] }
    }

    /// Intersection over union.
    pub fn iou(&self, other: &NearestBev) -> f32 {
        let side = |i: usize| (self.max[i].min(other.max[i]) - self.min[i].max(other.min[i])).max(0.0);
        let area = |b: &NearestBev| (b.max[0] - b.min[0]) * (b.max[1] - b.min[1]);
        let shared = side(0) * side(1);
        shared / (area(self) + area(other) - shared).max(1e-6)
    }
}

#[cfg(test)]
mod tests {
    use super::super::anchors::anchors;
    use super::super::box_coder::DIRECTION_OFFSET_RAD;
    use super::*;
    use proptest::prelude::*;

    fn classes() -> Vec<AnchorClass> {
        let class = |name: &str, size, bottom, matched, unmatched| AnchorClass {
            name: name.into(),
            size,
            bottom,
            rotations: vec![0.0, 1.57],
            matched,
            unmatched,
        };
        vec![class("Car", [3.9, 1.6, 1.56], -1.78, 0.6, 0.45), class("Pedestrian", [0.8, 0.6, 1.73], -0.6, 0.5, 0.35)]
    }

    const MAP: [usize; 2] = [24, 20];

    fn small_map() -> Vec<[f32; 7]> {
        anchors([0.0, -5.0, -3.0, 8.0, 5.0, 1.0], MAP, &classes())
    }

    /// The reference algorithm with the full IoU matrix.
    fn assign_by_matrix(
        anchors: &[[f32; 7]],
        classes: &[AnchorClass],
        boxes: &[[f32; 8]],
    ) -> (Vec<i32>, Vec<(usize, usize)>) {
        let per_cell = anchors_per_cell(classes);
        let (mut labels, mut taken) = (vec![0; anchors.len()], Vec::new());
        let mut first_slot = 0;
        for (c, class) in classes.iter().enumerate() {
            let slots = first_slot..first_slot + class.rotations.len();
            first_slot = slots.end;
            let mine: Vec<usize> = (0..anchors.len()).filter(|a| slots.contains(&(a % per_cell))).collect();
            let truths: Vec<usize> = (0..boxes.len()).filter(|&t| boxes[t][7] == (c + 1) as f32).collect();
            if truths.is_empty() {
                continue;
            }
            let matrix: Vec<Vec<f32>> = mine
                .iter()
                .map(|&a| {
                    truths.iter().map(|&t| NearestBev::new(&anchors[a]).iou(&NearestBev::new(&boxes[t]))).collect()
                })
                .collect();
            let argmax = |row: &[f32]| (0..row.len()).fold(0, |best, t| if row[t] > row[best] { t } else { best });
            let gt_max: Vec<f32> = (0..truths.len())
                .map(|t| matrix.iter().map(|row| row[t]).fold(0.0, f32::max))
                .map(|max| if max == 0.0 { -1.0 } else { max })
                .collect();
            let forced = |row: &[f32]| (0..row.len()).any(|t| row[t] == gt_max[t]);
            for (&a, row) in mine.iter().zip(&matrix) {
                let (t, most) = (argmax(row), row[argmax(row)]);
                labels[a] = -1;
                if forced(row) || most >= class.matched {
                    labels[a] = c as i32 + 1;
                }
                if most < class.unmatched {
                    labels[a] = 0;
                }
                if forced(row) {
                    labels[a] = c as i32 + 1;
                }
                if labels[a] > 0 {
                    taken.push((a, truths[t]));
                }
            }
        }
        taken.sort_unstable();
        (labels, taken)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(60))]
        #[test]
        fn equals_the_whole_matrix(
            boxes in prop::collection::vec(
                (-2.0f32..10.0, -7.0f32..7.0, 0.3f32..5.0, 0.3f32..3.0, -3.2f32..3.2, 0u8..4, any::<bool>()), 0..12)
        ) {
            let mut truth = Vec::new();
            for (x, y, dx, dy, yaw, class, twice) in boxes {
                // Quantised positions and repeated boxes give ties.
                let (x, y) = if twice { ((x * 2.0).round() / 2.0, (y * 2.0).round() / 2.0) } else { (x, y) };
                let bbox = [x, y, -1.0, dx, dy, 1.5, yaw, f32::from(class)];
                truth.push(bbox);
                if twice {
                    truth.push(bbox);
                }
            }
            let anchors = small_map();
            let targets = assign(&anchors, &classes(), MAP, &truth, DIRECTION_OFFSET_RAD);
            let (labels, positive) = assign_by_matrix(&anchors, &classes(), &truth);
            prop_assert_eq!(&targets.labels, &labels);
            prop_assert_eq!(&targets.positive, &positive);
        }
    }

    #[test]
    fn a_frame_without_boxes_is_background() {
        let targets = assign(&small_map(), &classes(), MAP, &[], DIRECTION_OFFSET_RAD);
        assert!(targets.labels.iter().all(|&l| l == 0) && targets.positive.is_empty());
    }

    #[test]
    fn a_box_outside_the_map_matches_no_anchor() {
        let far = [100.0, 0.0, -1.0, 3.9, 1.6, 1.5, 0.0, 1.0];
        let flat = [4.0, 0.0, -1.0, 0.0, 1.6, 1.5, 0.0, 1.0];
        let broken = [f32::NAN, 0.0, -1.0, 3.9, 1.6, 1.5, 0.0, 1.0];
        let targets = assign(&small_map(), &classes(), MAP, &[far, flat, broken], DIRECTION_OFFSET_RAD);
        assert!(targets.positive.is_empty());
    }

    #[test]
    fn the_best_anchor_is_forced_below_the_threshold() {
        let child = [3.1, 0.2, -1.0, 0.2, 0.2, 0.9, 0.3, 2.0];
        let targets = assign(&small_map(), &classes(), MAP, &[child], DIRECTION_OFFSET_RAD);
        assert!(!targets.positive.is_empty());
        assert!(targets.positive.iter().all(|&(a, t)| t == 0 && targets.labels[a] == 2));
        assert_eq!(targets.reg.len(), targets.positive.len());
        assert!(targets.dir.iter().all(|&bin| bin == 1));
    }
}
