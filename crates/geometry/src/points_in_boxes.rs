//! Which points lie in which boxes.

use crate::Box3;

/// Cells along each side of the grid.
const CELLS: usize = 64;

/// For each box the indices of the points inside, ascending. `points` holds `channels` values each, x, y, z first.
///
/// A point is inside by OpenPCDet's rule in the box frame: |z| <= dz/2, |x| < dx/2 + margin, |y| < dy/2 + margin.
/// OpenPCDet's margin is 1e-5 m on the GPU and 1e-2 m on the CPU. Points that are not finite are in no box, and boxes
/// without extent contain no points.
///
/// # Shapes
/// `points`: `[N * channels]`; out: one list a box.
pub fn points_in_boxes(points: &[f32], channels: usize, boxes: &[Box3], margin_m: f64) -> Vec<Vec<u32>> {
    assert!(
        channels >= 3 && points.len().is_multiple_of(channels),
        "points of {channels} values do not fill {}",
        points.len()
    );
    let mut inside = vec![Vec::new(); boxes.len()];
    let tests: Vec<InsideTest> =
        boxes.iter().enumerate().filter_map(|(i, b)| InsideTest::new(i, b, margin_m)).collect();
    let Some(grid) = BoxGrid::new(&tests) else { return inside };
    for (i, p) in points.chunks_exact(channels).enumerate() {
        let p = [f64::from(p[0]), f64::from(p[1]), f64::from(p[2])];
        for &k in grid.boxes_near(p[0], p[1]) {
            let test = &tests[k as usize];
            if test.holds(p) {
                inside[test.index].push(i as u32);
            }
        }
    }
    inside
}

/// A box with precomputed quantities for testing points.
struct InsideTest {
    index: usize,
    center: [f64; 3],
    half: [f64; 3],
    sin: f64,
    cos: f64,
    /// Lowest and highest x and y that can be inside, rounded outwards.
    low: [f64; 2],
    high: [f64; 2],
}

impl InsideTest {
    fn new(index: usize, b: &Box3, margin_m: f64) -> Option<Self> {
        if !b.size.iter().all(|&s| s > 0.0) || !b.to_array().iter().all(|v| v.is_finite()) {
            return None;
        }
        let (sin, cos) = b.yaw_rad.sin_cos();
        let half = [b.size[0] / 2.0 + margin_m, b.size[1] / 2.0 + margin_m, b.size[2] / 2.0];
        let reach = [half[0] * cos.abs() + half[1] * sin.abs(), half[0] * sin.abs() + half[1] * cos.abs()];
        let mut test = InsideTest { index, center: b.center, half, sin, cos, low: [0.0; 2], high: [0.0; 2] };
        for axis in [0, 1] {
            let outwards = reach[axis] + 1e-9 * (1.0 + reach[axis] + b.center[axis].abs());
            test.low[axis] = b.center[axis] - outwards;
            test.high[axis] = b.center[axis] + outwards;
        }
        Some(test)
    }

    fn holds(&self, p: [f64; 3]) -> bool {
        let (x, y) = (p[0] - self.center[0], p[1] - self.center[1]);
        (p[2] - self.center[2]).abs() <= self.half[2]
            && (x * self.cos + y * self.sin).abs() < self.half[0]
            && (y * self.cos - x * self.sin).abs() < self.half[1]
    }
}

/// The boxes over each cell of a grid that covers all of them.
struct BoxGrid {
    low: [f64; 2],
    cells_per_m: [f64; 2],
    /// Cell c has `boxes[starts[c]..starts[c + 1]]`.
    starts: Vec<u32>,
    boxes: Vec<u32>,
}

impl BoxGrid {
    fn new(tests: &[InsideTest]) -> Option<Self> {
        tests.first()?;
        let mut grid = BoxGrid { low: [0.0; 2], cells_per_m: [0.0; 2], starts: Vec::new(), boxes: Vec::new() };
        for axis in [0, 1] {
            grid.low[axis] = tests.iter().map(|t| t.low[axis]).fold(f64::INFINITY, f64::min);
            let high = tests.iter().map(|t| t.high[axis]).fold(f64::NEG_INFINITY, f64::max);
            grid.cells_per_m[axis] = CELLS as f64 / (high - grid.low[axis]);
        }
        // Counted, then filled: an allocation for each cell would cost more than a small cloud.
        let cells: Vec<[usize; 4]> = tests
            .iter()
            .map(|test| {
                let [x0, y0] = [0, 1].map(|axis| grid.index(axis, test.low[axis]));
                let [x1, y1] = [0, 1].map(|axis| grid.index(axis, test.high[axis]));
                [x0, x1, y0, y1]
            })
            .collect();
        let rows = |&[x0, x1, y0, y1]: &[usize; 4]| (x0..=x1).map(move |x| x * CELLS + y0..x * CELLS + y1 + 1);
        let mut starts = vec![0; CELLS * CELLS + 1];
        for row in cells.iter().flat_map(rows) {
            starts[row.start + 1..=row.end].iter_mut().for_each(|count| *count += 1);
        }
        for cell in 1..starts.len() {
            starts[cell] += starts[cell - 1];
        }
        grid.boxes = vec![0; starts[CELLS * CELLS] as usize];
        let mut next: Vec<u32> = starts[..CELLS * CELLS].to_vec();
        for (k, cells) in cells.iter().enumerate() {
            for cell in rows(cells).flatten() {
                grid.boxes[next[cell] as usize] = k as u32;
                next[cell] += 1;
            }
        }
        grid.starts = starts;
        Some(grid)
    }

    /// Monotone in `v`, so that a point within the bounds of a box is in a cell within the cells of these bounds.
    fn index(&self, axis: usize, v: f64) -> usize {
        (((v - self.low[axis]) * self.cells_per_m[axis]) as i32).clamp(0, CELLS as i32 - 1) as usize
    }

    /// Candidate boxes of a point. Points outside the grid or not finite get those of a border cell; this avoids a
    /// branch.
    fn boxes_near(&self, x: f64, y: f64) -> &[u32] {
        let cell = self.index(0, x) * CELLS + self.index(1, y);
        &self.boxes[self.starts[cell] as usize..self.starts[cell + 1] as usize]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn borders_and_bad_points() {
        let b = Box3::from_array([1.0, 2.0, 3.0, 4.0, 2.0, 2.0, 0.0]);
        let points = [
            [1.0, 2.0, 4.0],      // on the top: inside
            [3.0, 2.0, 3.0],      // on the front: outside without a margin
            [1.0, 2.999, 3.0],    // inside
            [f32::NAN, 2.0, 3.0], // in no box
            [1.0, f32::INFINITY, 3.0],
        ]
        .concat();
        assert_eq!(points_in_boxes(&points, 3, &[b], 0.0), [vec![0, 2]]);
        assert_eq!(points_in_boxes(&points, 3, &[b], 1e-5), [vec![0, 1, 2]]);
        let flat = Box3 { size: [0.0; 3], ..b };
        let nan = Box3 { center: [f64::NAN; 3], ..b };
        assert_eq!(points_in_boxes(&points, 3, &[flat, b, nan], 0.0), [vec![], vec![0, 2], vec![]]);
        assert_eq!(points_in_boxes(&[], 4, &[b], 0.0), [Vec::<u32>::new()]);
        assert!(points_in_boxes(&points, 3, &[], 0.0).is_empty());
    }

    proptest! {
        #[test]
        fn equals_testing_every_point(
            boxes in prop::collection::vec((-50.0..50.0f64, -50.0..50.0f64, 0.0..20.0f64, 0.0..20.0f64, -7.0..7.0f64), 0..12),
            points in prop::collection::vec((-60.0..60.0f32, -60.0..60.0f32, -2.0..2.0f32), 0..400),
        ) {
            let boxes: Vec<Box3> =
                boxes.iter().map(|v| Box3::from_array([v.0, v.1, 0.0, v.2, v.3, 2.0, v.4])).collect();
            let flat: Vec<f32> = points.iter().flat_map(|p| [p.0, p.1, p.2, 0.5]).collect();
            let got = points_in_boxes(&flat, 4, &boxes, 0.01);
            for (b, got) in boxes.iter().zip(got) {
                let want: Vec<u32> = (0..points.len() as u32)
                    .filter(|&i| {
                        let p = points[i as usize];
                        let q = b.to_local([f64::from(p.0), f64::from(p.1), f64::from(p.2)]);
                        b.size.iter().all(|&s| s > 0.0)
                            && q[0].abs() < b.size[0] / 2.0 + 0.01
                            && q[1].abs() < b.size[1] / 2.0 + 0.01
                            && q[2].abs() <= b.size[2] / 2.0
                    })
                    .collect();
                prop_assert_eq!(got, want);
            }
        }
    }
}
