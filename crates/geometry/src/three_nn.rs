//! The three nearest known points of each point (Qi et al. 2017, PointNet++; OpenPCDet: `three_nn`).

use crate::point_grid::PointGrid;
use rayon::prelude::*;

/// Points a task.
const TASK: usize = 256;

/// Smallest average number of known points in a grid cell.
const IN_CELL: f64 = 2.0;

/// Nearest first.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ThreeNearest {
    /// Indices into the known points.
    pub index: Vec<[u32; 3]>,
    /// Squared distances, m2; infinite, with index 0, if there are fewer than three known points.
    pub distance2: Vec<[f32; 3]>,
}

/// The three nearest of `known` for each of `unknown`; ties by lower index. Distances are f32, as in the reference.
/// Known points that are not finite are never neighbours.
///
/// # Shapes
/// `unknown`: `[N]`, `known`: `[M]`, m; results `[N, 3]`.
pub fn three_nearest(unknown: &[[f32; 3]], known: &[[f32; 3]]) -> ThreeNearest {
    let grid = PointGrid::new(known, 0.0, IN_CELL);
    let mut found =
        ThreeNearest { index: vec![[0; 3]; unknown.len()], distance2: vec![[f32::INFINITY; 3]; unknown.len()] };
    let tasks = found.index.par_chunks_mut(TASK).zip(found.distance2.par_chunks_mut(TASK));
    unknown.par_chunks(TASK).zip(tasks).for_each(|(points, (index, distance2))| {
        for (i, &p) in points.iter().enumerate() {
            let best = nearest(&grid, p);
            (index[i], distance2[i]) = (best.map(|(_, k)| k), best.map(|(d, _)| d));
        }
    });
    found
}

/// Squared distance and index of the three nearest points.
fn nearest(grid: &PointGrid, p: [f32; 3]) -> [(f32, u32); 3] {
    let mut best = [(f32::INFINITY, 0); 3];
    let at = [0, 1].map(|axis| f64::from(p[axis]));
    let cell = [0, 1].map(|axis| grid.cell(axis, at[axis]));
    let last = [0, 1].map(|axis| grid.size[axis] - 1);
    for ring in 0.. {
        let from = cell.map(|c| c.saturating_sub(ring));
        let to = [0, 1].map(|axis| (cell[axis] + ring).min(last[axis]));
        for x in from[0]..=to[0] {
            if x.abs_diff(cell[0]) == ring {
                visit(grid, grid.run(x, from[1], to[1]), p, &mut best);
            } else {
                // The inner part of this column was visited before.
                for y in
                    [cell[1].checked_sub(ring), Some(cell[1] + ring).filter(|y| *y <= last[1])].into_iter().flatten()
                {
                    visit(grid, grid.run(x, y, y), p, &mut best);
                }
            }
        }
        // All points not yet visited lie beyond these borders.
        let beyond = |axis: usize| {
            let (low, high) = (grid.border_m(axis, from[axis]), grid.border_m(axis, to[axis] + 1));
            (at[axis] - low).min(high - at[axis]).max(0.0)
        };
        let apart = beyond(0).min(beyond(1));
        let all_seen = from == [0, 0] && to == last;
        if all_seen || apart * apart * (1.0 - 1e-6) > f64::from(best[2].0) {
            break;
        }
    }
    best
}

/// Inserts the points at these positions of the grid into the sorted list of the nearest.
fn visit(grid: &PointGrid, places: std::ops::Range<usize>, p: [f32; 3], best: &mut [(f32, u32); 3]) {
    let [x, y, z] = [0, 1, 2].map(|axis| &grid.xyz[axis][places.clone()]);
    for (k, &i) in grid.index[places].iter().enumerate() {
        let apart = [p[0] - x[k], p[1] - y[k], p[2] - z[k]];
        let d = apart[0] * apart[0] + apart[1] * apart[1] + apart[2] * apart[2];
        let before = |other: (f32, u32)| d < other.0 || (d == other.0 && i < other.1);
        if before(best[2]) && d < f32::INFINITY {
            *best = match () {
                () if before(best[0]) => [(d, i), best[0], best[1]],
                () if before(best[1]) => [best[0], (d, i), best[1]],
                () => [best[0], best[1], (d, i)],
            };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn plain(unknown: &[[f32; 3]], known: &[[f32; 3]]) -> ThreeNearest {
        let mut found = ThreeNearest::default();
        for p in unknown {
            let distance2 = |q: &[f32; 3]| {
                let apart = [0, 1, 2].map(|axis| p[axis] - q[axis]);
                apart[0] * apart[0] + apart[1] * apart[1] + apart[2] * apart[2]
            };
            let mut all: Vec<(f32, u32)> = known.iter().enumerate().map(|(k, q)| (distance2(q), k as u32)).collect();
            all.sort_by(|a, b| a.0.total_cmp(&b.0)); // stable: equal ones stay by index
            all.resize(all.len().max(3), (f32::INFINITY, 0));
            found.index.push([all[0].1, all[1].1, all[2].1]);
            found.distance2.push([all[0].0, all[1].0, all[2].0]);
        }
        found
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(1000))]
        #[test]
        fn equals_a_sort_of_all_distances(
            unknown in prop::collection::vec(prop::array::uniform3(-9.0f32..9.0), 0..60),
            known in prop::collection::vec(prop::array::uniform3(-6.0f32..6.0), 0..200),
            raster in prop_oneof![Just(0.0f32), Just(0.25), Just(2.0)],
            flat in any::<bool>(),
            shift_m in prop_oneof![Just(0.0f32), Just(1000.0)],
        ) {
            let place = |v: f32| shift_m + if raster > 0.0 { (v / raster).round() * raster } else { v };
            let in_line = |p: &[f32; 3]| if flat { [p[0], 1.0, p[2]] } else { *p };
            let known: Vec<[f32; 3]> = known.iter().map(|p| in_line(p).map(place)).collect();
            let mut unknown: Vec<[f32; 3]> = unknown.iter().map(|p| p.map(place)).collect();
            unknown.extend(known.iter().take(40));
            prop_assert_eq!(three_nearest(&unknown, &known), plain(&unknown, &known));
        }
    }

    #[test]
    fn fewer_than_three_and_nothing_finite() {
        let found = three_nearest(&[[0.0; 3]], &[[1.0, 0.0, 0.0], [f32::NAN; 3]]);
        assert_eq!((found.index[0], found.distance2[0]), ([0, 0, 0], [1.0, f32::INFINITY, f32::INFINITY]));
        assert_eq!(three_nearest(&[[f32::NAN; 3]], &[[0.0; 3]; 5]).index, [[0; 3]]);
        assert_eq!(three_nearest(&[[2.0; 3]], &[]).index, [[0; 3]]);
        let equal = three_nearest(&[[2.0; 3]], &[[1.0; 3]; 9]);
        assert_eq!(equal.index, [[0, 1, 2]]);
    }
}
