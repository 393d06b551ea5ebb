//! Targets of the heads (OpenPCDet: `CenterHead.assign_targets`).

use super::box_coder::{CenterGrid, Code};
use super::config::CenterTargetsConfig;
use super::heat_map::{draw_peak, gaussian_radius};

/// Targets of one head in one frame.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct HeadTargets {
    /// `[classes of the head, rows, columns]`, 0 to 1, 1 at the cell of a box.
    pub heat_map: Vec<f32>,
    /// Cell and code of each box of the head's classes, in the order of the frame; `None` for a box without extent.
    pub boxes: Vec<Option<(usize, Code)>>,
}

/// Targets of one frame, one entry a head.
pub type Targets = Vec<HeadTargets>;

/// Targets of one frame for the head with these classes (indices from 0).
///
/// `boxes` are `[x, y, z, dx, dy, dz, yaw, class]`, classes counted from 1; those of other classes are ignored, and all
/// after the first `max_boxes`.
pub fn assign(grid: &CenterGrid, classes: &[usize], config: &CenterTargetsConfig, boxes: &[[f32; 8]]) -> HeadTargets {
    let cells = grid.cells();
    let mut targets = HeadTargets { heat_map: vec![0.0; classes.len() * cells], boxes: Vec::new() };
    let of_head = boxes.iter().filter_map(|bbox| {
        let class = classes.iter().position(|&class| bbox[7] == (class + 1) as f32)?;
        Some((class, bbox))
    });
    for (class, &[x, y, z, dx, dy, dz, yaw, _]) in of_head.take(config.max_boxes) {
        let [length, width] = [grid.cells_of_length(dx, 0), grid.cells_of_length(dy, 1)];
        if !(length > 0.0 && width > 0.0 && x.is_finite() && y.is_finite()) {
            targets.boxes.push(None);
            continue;
        }
        let radius = (gaussian_radius(length, width, config.gaussian_overlap) as usize).max(config.min_radius);
        let cell = grid.row_and_column(grid.position([x, y]));
        draw_peak(&mut targets.heat_map[class * cells..(class + 1) * cells], grid.map, cell, radius);
        targets.boxes.push(Some(grid.encode([x, y, z, dx, dy, dz, yaw])));
    }
    targets
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid() -> CenterGrid {
        CenterGrid { origin_m: [0.0, -8.0], pillar_m: [0.5, 0.5], stride: 1, map: [32, 24] }
    }

    const CAR: [f32; 8] = [3.1, 0.2, -1.0, 4.0, 2.0, 1.5, 0.3, 1.0];

    fn assign_all(boxes: &[[f32; 8]]) -> HeadTargets {
        assign(&grid(), &[0, 2], &CenterTargetsConfig::default(), boxes)
    }

    #[test]
    fn a_box_is_a_peak_of_its_class() {
        let cyclist = [9.0, -5.0, -1.0, 1.8, 0.6, 1.7, -2.0, 3.0];
        let pedestrian = [5.0, 5.0, -1.0, 0.8, 0.6, 1.7, 0.0, 2.0];
        let targets = assign_all(&[CAR, pedestrian, cyclist]);
        let cells = grid().cells();
        let peaks = |class: usize| {
            let map = &targets.heat_map[class * cells..(class + 1) * cells];
            (0..cells).filter(|&cell| map[cell] == 1.0).collect::<Vec<_>>()
        };
        let cell_of = |index: usize| targets.boxes[index].map(|(cell, _)| cell);
        assert_eq!(targets.boxes.len(), 2, "the head does not have the second class");
        assert_eq!(peaks(0), [16 * 24 + 6]);
        assert_eq!((Some(peaks(0)[0]), Some(peaks(1)[0])), (cell_of(0), cell_of(1)));
        let (_, code) = targets.boxes[0].unwrap();
        let want = [0.2, 0.4, -1.0, 4f32.ln(), 2f32.ln(), 1.5f32.ln(), 0.3f32.cos(), 0.3f32.sin()];
        assert!(code.iter().zip(want).all(|(a, b)| (a - b).abs() < 1e-5), "{code:?}");
    }

    #[test]
    fn a_peak_outside_the_map_is_at_its_border() {
        let far = [-5.0, 100.0, -1.0, 4.0, 2.0, 1.5, 0.0, 1.0];
        let targets = assign_all(&[far]);
        let (cell, code) = targets.boxes[0].unwrap();
        assert_eq!((cell, code[0], code[1]), (31 * 24, 0.0, 0.5));
        assert_eq!(targets.heat_map[cell], 1.0);
    }

    #[test]
    fn boxes_without_extent_and_too_many_boxes() {
        let flat = [3.1, 0.2, -1.0, 0.0, 2.0, 1.5, 0.3, 1.0];
        let broken = [f32::NAN, 0.2, -1.0, 4.0, 2.0, 1.5, 0.3, 1.0];
        let targets = assign_all(&[flat, broken, CAR]);
        assert_eq!(targets.boxes.iter().map(Option::is_some).collect::<Vec<_>>(), [false, false, true]);
        let two = CenterTargetsConfig { max_boxes: 2, ..Default::default() };
        let targets = assign(&grid(), &[0], &two, &[flat, CAR, CAR]);
        assert_eq!(targets.boxes.len(), 2);
        let none = assign_all(&[]);
        assert!(none.boxes.is_empty() && none.heat_map.iter().all(|&h| h == 0.0));
    }
}
