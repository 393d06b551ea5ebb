//! Voxelisation of points into pillars, and decoration of points (OpenPCDet: `Point2Voxel`, `PillarVFE`).

/// Marks a cell without a pillar, or a point that is dropped.
const NONE: u32 = u32::MAX;

/// The grid of the pillars and its limits.
#[derive(Clone, Debug, PartialEq)]
pub struct PillarGrid {
    /// `[x_min, y_min, z_min, x_max, y_max, z_max]`, m, LiDAR frame.
    pub range: [f32; 6],
    /// Extent of a cell along x, y and z, m.
    pub size: [f32; 3],
    /// Largest number of points of a pillar; the first ones are kept.
    pub max_points: usize,
    /// Largest number of pillars of a frame; the first ones are kept.
    pub max_pillars: usize,
}

impl PillarGrid {
    /// Number of cells along x, y and z: the range over the cell size, rounded.
    pub fn grid_size(&self) -> [usize; 3] {
        [0, 1, 2].map(|i| {
            let extent_m = f64::from(self.range[i + 3]) - f64::from(self.range[i]);
            (extent_m / f64::from(self.size[i])).round() as usize
        })
    }

    /// Cell of a point along x, y and z: `floor((p - min) / size)` in f32; `None` outside the grid and for NaN.
    fn cell(&self, point: &[f32], cells: [usize; 3]) -> Option<[usize; 3]> {
        let mut cell = [0; 3];
        for i in 0..3 {
            let position = (point[i] - self.range[i]) / self.size[i];
            if !(position >= 0.0 && position < cells[i] as f32) {
                return None;
            }
            cell[i] = position as usize;
        }
        Some(cell)
    }
}

/// The kept points of one frame, sorted by pillar. P pillars hold N points of C values each.
#[derive(Clone, Debug, PartialEq)]
pub struct Pillars {
    /// Cell of each pillar as `[z, y, x]`, in the order of their first points. Length P.
    pub coords_zyx: Vec<[u32; 3]>,
    /// Points kept in each pillar, at least one. Length P.
    pub num_points: Vec<u32>,
    /// Values of the kept points, sorted by pillar and then in the order of the cloud. `[N, C]`.
    pub points: Vec<f32>,
    /// Pillar of each kept point, ascending. Length N.
    pub pillar_of_point: Vec<u32>,
    /// Index of each kept point in the cloud. Length N.
    pub point_index: Vec<u32>,
    /// C: x, y, z in m, LiDAR frame, then intensity if present.
    pub channels: usize,
    /// Number of points inside the grid that were dropped because of the limits.
    pub dropped: usize,
}

/// Sorts a cloud of `channels` values a point into pillars.
///
/// A point creates a pillar in its cell while there are fewer than `max_pillars`, and joins one while it has fewer than
/// `max_points`. Points outside the grid, also in z, are dropped.
pub fn pillarise(points: &[f32], channels: usize, grid: &PillarGrid) -> Pillars {
    assert!(channels >= 3 && points.len().is_multiple_of(channels), "points of {channels} values");
    let cells @ [nx, ny, nz] = grid.grid_size();
    let mut pillar_at = vec![NONE; nx * ny * nz];
    let (mut coords_zyx, mut num_points) = (Vec::<[u32; 3]>::new(), Vec::<u32>::new());
    let mut dropped = 0;
    let pillar_of = points.chunks_exact(channels).map(|point| {
        let Some([x, y, z]) = grid.cell(point, cells) else { return NONE };
        let pillar = &mut pillar_at[(z * ny + y) * nx + x];
        if *pillar == NONE && coords_zyx.len() < grid.max_pillars {
            *pillar = coords_zyx.len() as u32;
            coords_zyx.push([z, y, x].map(|c| c as u32));
            num_points.push(0);
        }
        match num_points.get_mut(*pillar as usize) {
            Some(count) if (*count as usize) < grid.max_points => {
                *count += 1;
                *pillar
            }
            _ => {
                dropped += 1;
                NONE
            }
        }
    });
    let pillar_of: Vec<u32> = pillar_of.collect();

    // Counting sort by pillar: `next` is the position of the pillar's next point.
    let mut total = 0;
    let mut next = Vec::with_capacity(num_points.len());
    for &count in &num_points {
        next.push(total);
        total += count as usize;
    }
    let mut point_index = vec![0; total];
    let mut pillar_of_point = vec![0; total];
    let mut kept = vec![0.0; total * channels];
    for (i, (point, &pillar)) in points.chunks_exact(channels).zip(&pillar_of).enumerate() {
        if pillar != NONE {
            let to = next[pillar as usize];
            next[pillar as usize] += 1;
            point_index[to] = i as u32;
            pillar_of_point[to] = pillar;
            kept[to * channels..(to + 1) * channels].copy_from_slice(point);
        }
    }
    Pillars { coords_zyx, num_points, points: kept, pillar_of_point, point_index, channels, dropped }
}

/// The input of the pillar feature net for each kept point: its C values, its offset from the mean of the pillar's kept
/// points (m), and its offset from the pillar's centre (m), each along three axes.
///
/// # Shapes
/// `[N, C + 6]`: 10 features with intensity, 9 without.
pub fn decorate(pillars: &Pillars, grid: &PillarGrid) -> Vec<f32> {
    let channels = pillars.channels;
    let first_center = [0, 1, 2].map(|i| grid.size[i] / 2.0 + grid.range[i]);
    let mut features = Vec::with_capacity(pillars.pillar_of_point.len() * (channels + 6));
    let mut rest = pillars.points.as_slice();
    for (&[z, y, x], &count) in pillars.coords_zyx.iter().zip(&pillars.num_points) {
        let (points, others) = rest.split_at(count as usize * channels);
        rest = others;
        let mut mean = [0.0f32; 3];
        for point in points.chunks_exact(channels) {
            (0..3).for_each(|i| mean[i] += point[i]);
        }
        let mean = mean.map(|sum| sum / count as f32);
        let cell = [x, y, z];
        let center = [0, 1, 2].map(|i| cell[i] as f32 * grid.size[i] + first_center[i]);
        for point in points.chunks_exact(channels) {
            features.extend_from_slice(point);
            features.extend([0, 1, 2].map(|i| point[i] - mean[i]));
            features.extend([0, 1, 2].map(|i| point[i] - center[i]));
        }
    }
    features
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::BTreeMap;

    fn grid(max_points: usize, max_pillars: usize) -> PillarGrid {
        PillarGrid { range: [0.0, -2.0, -1.0, 4.0, 2.0, 1.0], size: [0.5, 0.5, 2.0], max_points, max_pillars }
    }

    #[test]
    fn the_published_grid() {
        let grid = PillarGrid {
            range: [0.0, -39.68, -3.0, 69.12, 39.68, 1.0],
            size: [0.16, 0.16, 4.0],
            max_points: 32,
            max_pillars: 40_000,
        };
        assert_eq!(grid.grid_size(), [432, 496, 1]);
    }

    #[test]
    fn first_come_first_kept() {
        // Cells of the x axis: 2, 0, 2, outside, 2 (full), 1 (one pillar too many), 0 (known).
        let x = [1.1, 0.1, 1.2, -0.1, 1.3, 0.6, 0.2];
        let points: Vec<f32> = x.iter().flat_map(|&x| [x, -2.0, 0.0]).collect();
        let pillars = pillarise(&points, 3, &grid(2, 2));
        assert_eq!(pillars.coords_zyx, [[0, 0, 2], [0, 0, 0]]);
        assert_eq!(pillars.num_points, [2, 2]);
        assert_eq!(pillars.point_index, [0, 2, 1, 6]);
        assert_eq!(pillars.pillar_of_point, [0, 0, 1, 1]);
        assert_eq!(pillars.dropped, 2);
    }

    #[test]
    fn borders_and_what_is_no_number() {
        let inside = |p: [f32; 3]| !pillarise(&p, 3, &grid(2, 2)).point_index.is_empty();
        assert!(inside([0.0, -2.0, -1.0]));
        assert!(!inside([4.0, 0.0, 0.0]) && !inside([1.0, 2.0, 0.0]) && !inside([1.0, 0.0, 1.0]));
        assert!(!inside([-1e-6, 0.0, 0.0]) && !inside([1.0, 0.0, f32::NAN]) && !inside([f32::INFINITY, 0.0, 0.0]));
        let none = pillarise(&[], 4, &grid(2, 2));
        assert!(none.coords_zyx.is_empty() && decorate(&none, &grid(2, 2)).is_empty());
    }

    #[test]
    fn features_of_a_point() {
        let grid = grid(8, 8);
        let pillars = pillarise(&[0.1, -1.9, 0.0, 0.5, 0.3, -1.7, 0.5, 0.25], 4, &grid);
        let features = decorate(&pillars, &grid);
        let want = [0.1, -1.9, 0.0, 0.5, -0.1, -0.1, -0.25, -0.15, -0.15, 0.0];
        assert_eq!(features.len(), 20);
        assert!(features.iter().zip(want).all(|(a, b)| (a - b).abs() < 1e-6), "{features:?}");
    }

    proptest! {
        /// The definition with lists.
        #[test]
        fn equals_lists_of_points(
            points in prop::collection::vec((-0.5f32..4.5, -2.5f32..2.5, -1.5f32..1.5), 0..400),
            max_points in 1usize..6,
            max_pillars in 1usize..40,
        ) {
            let flat: Vec<f32> = points.iter().flat_map(|&(x, y, z)| [x, y, z]).collect();
            let pillars = pillarise(&flat, 3, &grid(max_points, max_pillars));
            let mut known: BTreeMap<[u32; 3], usize> = BTreeMap::new();
            let mut lists: Vec<([u32; 3], Vec<u32>)> = Vec::new();
            for (i, &(x, y, z)) in points.iter().enumerate() {
                let cell = [(z + 1.0) / 2.0, (y + 2.0) / 0.5, x / 0.5].map(f32::floor);
                if cell[0] != 0.0 || cell[1..].iter().any(|c| !(0.0..8.0).contains(c)) {
                    continue;
                }
                let cell = cell.map(|c| c as u32);
                if !known.contains_key(&cell) && lists.len() < max_pillars {
                    known.insert(cell, lists.len());
                    lists.push((cell, vec![]));
                }
                if let Some(&p) = known.get(&cell) && lists[p].1.len() < max_points {
                    lists[p].1.push(i as u32);
                }
            }
            prop_assert_eq!(&pillars.coords_zyx, &lists.iter().map(|l| l.0).collect::<Vec<_>>());
            prop_assert_eq!(&pillars.point_index, &lists.iter().flat_map(|l| l.1.clone()).collect::<Vec<_>>());
            let values: Vec<f32> = pillars.point_index.iter().flat_map(|&i| flat[i as usize * 3..][..3].to_vec()).collect();
            prop_assert_eq!(&pillars.points, &values);
        }
    }
}
