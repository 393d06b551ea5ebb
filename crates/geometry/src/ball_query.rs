//! Neighbours within a radius (Qi et al. 2017, PointNet++; OpenPCDet: `ball_query`).

use crate::point_grid::PointGrid;
use rayon::prelude::*;

/// Centres a task.
const TASK: usize = 128;

/// Smallest average number of points in a grid cell.
const IN_CELL: f64 = 0.25;

/// For each centre the indices of the first `samples` points nearer than `radius_m`, in the order of the points.
///
/// With fewer neighbours the remaining entries repeat the first one. A centre without neighbours gets index 0 in all
/// entries. The squared f32 distance must be smaller than the squared radius, as in the reference, so that the indices
/// are equal. Points that are not finite are never neighbours.
///
/// # Shapes
/// `points`: `[N]`, `centers`: `[M]`, m; result `[M, samples]`.
pub fn ball_query(points: &[[f32; 3]], centers: &[[f32; 3]], radius_m: f32, samples: usize) -> Vec<u32> {
    let mut index = vec![0; centers.len() * samples];
    if samples == 0 || centers.is_empty() {
        return index;
    }
    let grid = PointGrid::new(points, f64::from(radius_m), IN_CELL);
    let task = |(centers, index): (&[[f32; 3]], &mut [u32])| {
        let mut hits = Vec::new();
        for (&center, index) in centers.iter().zip(index.chunks_exact_mut(samples)) {
            find(&grid, center, radius_m, &mut hits);
            if hits.len() > samples {
                hits.select_nth_unstable(samples - 1);
                hits.truncate(samples);
            }
            hits.sort_unstable();
            index[..hits.len()].copy_from_slice(&hits);
            index[hits.len()..].fill(hits.first().copied().unwrap_or(0));
        }
    };
    if centers.len() <= TASK {
        task((centers, &mut index));
    } else {
        centers.par_chunks(TASK).zip(index.par_chunks_mut(TASK * samples)).for_each(task);
    }
    index
}

/// All points within the radius, in the order of the grid.
fn find(grid: &PointGrid, center: [f32; 3], radius_m: f32, hits: &mut Vec<u32>) {
    hits.clear();
    let radius2 = radius_m * radius_m;
    // The search range is slightly larger than the radius, because distances are rounded.
    let cells = |axis: usize| {
        let (v, reach) = (f64::from(center[axis]), f64::from(radius_m) * (1.0 + 1e-6) + 1e-30);
        (grid.cell(axis, v - reach), grid.cell(axis, v + reach))
    };
    let ((x_from, x_to), (y_from, y_to)) = (cells(0), cells(1));
    for x in x_from..=x_to {
        let run = grid.run(x, y_from, y_to);
        let mut count = hits.len();
        hits.resize(count + run.len(), 0);
        let [px, py, pz] = [0, 1, 2].map(|axis| &grid.xyz[axis][run.clone()]);
        for (k, &i) in grid.index[run].iter().enumerate() {
            let apart = [center[0] - px[k], center[1] - py[k], center[2] - pz[k]];
            let d = apart[0] * apart[0] + apart[1] * apart[1] + apart[2] * apart[2];
            hits[count] = i;
            count += usize::from(d < radius2);
        }
        hits.truncate(count);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn plain(points: &[[f32; 3]], centers: &[[f32; 3]], radius_m: f32, samples: usize) -> Vec<u32> {
        let mut index = Vec::new();
        for c in centers {
            let near = |p: &[f32; 3]| {
                let apart = [0, 1, 2].map(|axis| c[axis] - p[axis]);
                apart[0] * apart[0] + apart[1] * apart[1] + apart[2] * apart[2] < radius_m * radius_m
            };
            let hits: Vec<u32> =
                (0..points.len()).filter(|&i| near(&points[i])).take(samples).map(|i| i as u32).collect();
            let first = hits.first().copied().unwrap_or(0);
            index.extend((0..samples).map(|s| hits.get(s).copied().unwrap_or(first)));
        }
        index
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(1000))]
        #[test]
        fn equals_a_search_through_all_points(
            points in prop::collection::vec(prop::array::uniform3(-6.0f32..6.0), 0..400),
            centers in prop::collection::vec(prop::array::uniform3(-8.0f32..8.0), 0..20),
            raster in prop_oneof![Just(0.0f32), Just(0.25), Just(0.5)],
            radius_m in prop_oneof![Just(0.5f32), Just(1.0), 0.01f32..30.0],
            samples in 0usize..40,
            shift_m in prop_oneof![Just(0.0f32), Just(1000.0)],
        ) {
            let place = |v: f32| shift_m + if raster > 0.0 { (v / raster).round() * raster } else { v };
            let points: Vec<[f32; 3]> = points.iter().map(|p| p.map(place)).collect();
            let mut centers: Vec<[f32; 3]> = centers.iter().map(|p| p.map(place)).collect();
            centers.extend(points.iter().take(200));
            let got = ball_query(&points, &centers, radius_m, samples);
            prop_assert_eq!(got, plain(&points, &centers, radius_m, samples));
        }
    }

    #[test]
    fn no_neighbours_and_no_finite_point() {
        assert_eq!(ball_query(&[[0.0; 3]], &[[5.0; 3]], 1.0, 2), [0, 0]);
        assert_eq!(ball_query(&[], &[[5.0; 3]], 1.0, 2), [0, 0]);
        assert!(ball_query(&[[0.0; 3]], &[], 1.0, 2).is_empty());
        let broken = [[f32::NAN, 0.0, 0.0], [0.0; 3], [0.1, f32::INFINITY, 0.0], [0.2, 0.0, 0.0]];
        assert_eq!(ball_query(&broken, &[[0.0; 3], [f32::NAN; 3]], 1.0, 3), [1, 3, 1, 0, 0, 0]);
    }
}
