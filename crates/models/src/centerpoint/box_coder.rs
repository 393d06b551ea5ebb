//! Boxes as a cell of the feature map and eight numbers (OpenPCDet: `CenterHead.assign_target_of_single_head`,
//! `decode_bbox_from_heatmap`).
//!
//! All in f32, in the reference's order of operations. Boxes are `[x, y, z, dx, dy, dz, yaw]`, m and rad, LiDAR frame.

/// Offset of the centre from the corner of its cell along x and y (in cells), z (m), logarithms of the sizes (m),
/// cosine and sine of the heading.
pub type Code = [f32; 8];

/// The feature map over the range.
#[derive(Clone, Debug, PartialEq)]
pub struct CenterGrid {
    /// x and y of the corner of the first cell, m.
    pub origin_m: [f32; 2],
    /// Extent of a pillar along x and y, m.
    pub pillar_m: [f32; 2],
    /// Pillars that a cell spans along x and y.
    pub stride: usize,
    /// Rows (y) and columns (x) of the map.
    pub map: [usize; 2],
}

impl CenterGrid {
    /// Number of cells.
    pub fn cells(&self) -> usize {
        self.map[0] * self.map[1]
    }

    /// A length along `axis` (0 for x, 1 for y) in cells.
    pub fn cells_of_length(&self, length_m: f32, axis: usize) -> f32 {
        length_m / self.pillar_m[axis] / self.stride as f32
    }

    /// The position of a centre in cells. Outside the map it is moved to the border: to 0, or to half a cell before the
    /// end.
    pub fn position(&self, center_m: [f32; 2]) -> [f32; 2] {
        [0, 1].map(|axis| {
            let position = self.cells_of_length(center_m[axis] - self.origin_m[axis], axis);
            position.max(0.0).min(self.map[1 - axis] as f32 - 0.5)
        })
    }

    /// Row and column of a position.
    pub fn row_and_column(&self, position: [f32; 2]) -> [usize; 2] {
        [position[1] as usize, position[0] as usize]
    }

    /// The cell of a box, row-major, and its code.
    pub fn encode(&self, bbox: [f32; 7]) -> (usize, Code) {
        let [x, y, z, dx, dy, dz, yaw] = bbox;
        let position = self.position([x, y]);
        let [row, column] = self.row_and_column(position);
        let offset = [position[0] - column as f32, position[1] - row as f32];
        (row * self.map[1] + column, [offset[0], offset[1], z, dx.ln(), dy.ln(), dz.ln(), yaw.cos(), yaw.sin()])
    }

    /// The box of a code at a cell; the inverse of [`CenterGrid::encode`].
    pub fn decode(&self, cell: usize, code: Code) -> [f32; 7] {
        let [offset_x, offset_y, z, dx, dy, dz, cosine, sine] = code;
        let (row, column) = (cell / self.map[1], cell % self.map[1]);
        let meters = |index: usize, offset: f32, axis: usize| {
            (index as f32 + offset) * self.stride as f32 * self.pillar_m[axis] + self.origin_m[axis]
        };
        let (x, y) = (meters(column, offset_x, 0), meters(row, offset_y, 1));
        [x, y, z, dx.exp(), dy.exp(), dz.exp(), sine.atan2(cosine)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn grid(stride: usize) -> CenterGrid {
        CenterGrid { origin_m: [0.0, -20.48], pillar_m: [0.32, 0.64], stride, map: [64 / stride, 128 / stride] }
    }

    proptest! {
        #[test]
        fn decode_inverts_encode(
            x in 0.0f32..40.5, y in -20.0f32..19.8, z in -3.0f32..1.0,
            size in prop::array::uniform3(0.3f32..6.0), yaw in -3.1f32..3.1, stride in 1usize..3,
        ) {
            let (grid, bbox) = (grid(stride), [x, y, z, size[0], size[1], size[2], yaw]);
            let (cell, code) = grid.encode(bbox);
            prop_assert!(cell < grid.cells());
            prop_assert!((0.0..1.0).contains(&code[0]) && (0.0..1.0).contains(&code[1]), "{:?}", code);
            let back = grid.decode(cell, code);
            prop_assert!((0..7).all(|i| (back[i] - bbox[i]).abs() < 2e-5), "{:?} {:?}", back, bbox);
        }
    }

    #[test]
    fn centers_outside_are_moved_to_the_border() {
        let grid = grid(1);
        for (center, cell, offset) in [
            ([-3.0, -30.0], [0, 0], [0.0, 0.0]),
            ([40.96, 20.48], [63, 127], [0.5, 0.5]),
            ([1e6, 1e6], [63, 127], [0.5, 0.5]),
            ([40.95, 0.0], [32, 127], [0.5, 0.0]),
        ] {
            let (found, code) = grid.encode([center[0], center[1], 0.0, 4.0, 2.0, 1.5, 0.0]);
            assert_eq!(found, cell[0] * 128 + cell[1], "{center:?}");
            assert!((code[0] - offset[0]).abs() < 1e-6 && (code[1] - offset[1]).abs() < 1e-6, "{center:?} {code:?}");
        }
    }

    #[test]
    fn the_order_of_the_cells() {
        let grid = CenterGrid { origin_m: [0.0, 0.0], pillar_m: [1.0, 1.0], stride: 1, map: [3, 5] };
        let (cell, code) = grid.encode([4.25, 1.5, -0.5, 1.0, 1.0, 1.0, 0.0]);
        assert_eq!(cell, 5 + 4, "rows are y, columns are x");
        assert_eq!(code, [0.25, 0.5, -0.5, 0.0, 0.0, 0.0, 1.0, 0.0]);
    }
}
