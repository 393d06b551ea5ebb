//! Points in voxels: thinned clouds, and the local map of the odometry.

use nalgebra::Point3;
use std::collections::{HashMap, HashSet};
use std::hash::{BuildHasherDefault, Hasher};

/// A voxel: its three indices of 21 bits each. Worlds of 2 million voxels along an axis wrap around.
pub(crate) type Key = u64;

/// A map by voxels.
pub(super) type ByVoxel<T> = HashMap<Key, T, BuildHasherDefault<KeyHasher>>;

/// Hashes a [`Key`] with a multiplication: keys are neither secret nor chosen by anyone.
#[derive(Clone, Copy, Default)]
pub(crate) struct KeyHasher(u64);

impl Hasher for KeyHasher {
    fn finish(&self) -> u64 {
        self.0
    }

    fn write(&mut self, _: &[u8]) {
        unreachable!("keys are u64");
    }

    fn write_u64(&mut self, key: u64) {
        let product = u128::from(key ^ 0x5851_f42d_4c95_7f2d) * 0x9e37_79b9_7f4a_7c15;
        self.0 = (product as u64) ^ ((product >> 64) as u64);
    }
}

/// The indices of the voxel of a point. `per_m` is the inverse of the side of a voxel.
pub(crate) fn indices(point: &Point3<f64>, per_m: f64) -> [i64; 3] {
    [0, 1, 2].map(|axis| (point[axis] * per_m).floor() as i64)
}

/// The key of indices.
pub(crate) fn key(indices: [i64; 3]) -> Key {
    let [x, y, z] = indices.map(|index| (index & 0x1f_ffff) as u64);
    x | y << 21 | z << 42
}

/// The first point in each voxel of side `voxel_m`, in the order of the points.
pub(crate) fn thin(points: &[Point3<f64>], voxel_m: f64) -> Vec<Point3<f64>> {
    let mut seen: HashSet<Key, BuildHasherDefault<KeyHasher>> = HashSet::default();
    let per_m = 1.0 / voxel_m;
    points.iter().filter(|p| seen.insert(key(indices(p, per_m)))).copied().collect()
}

/// The local map: a few points in each voxel.
#[derive(Clone, Debug)]
pub(super) struct VoxelMap {
    voxels: ByVoxel<Vec<Point3<f64>>>,
    voxel_m: f64,
    points_per_voxel: usize,
    /// Points of a voxel are at least this far apart, m, squared.
    apart_m2: f64,
}

impl VoxelMap {
    pub(super) fn new(voxel_m: f64, points_per_voxel: usize) -> Self {
        let apart_m2 = voxel_m * voxel_m / points_per_voxel as f64;
        VoxelMap { voxels: ByVoxel::default(), voxel_m, points_per_voxel, apart_m2 }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.voxels.is_empty()
    }

    /// Adds points, in world coordinates, to voxels that have room, unless a point of the voxel is near.
    pub(super) fn add(&mut self, points: impl Iterator<Item = Point3<f64>>) {
        let per_m = 1.0 / self.voxel_m;
        for point in points {
            let voxel = self.voxels.entry(key(indices(&point, per_m))).or_default();
            let near = |other: &Point3<f64>| (other - point).norm_squared() < self.apart_m2;
            if voxel.len() < self.points_per_voxel && !voxel.iter().any(near) {
                voxel.push(point);
            }
        }
    }

    /// Removes the voxels whose first point is farther from `center` than `range_m`.
    pub(super) fn remove_far(&mut self, center: &Point3<f64>, range_m: f64) {
        self.voxels.retain(|_, points| (points[0] - center).norm_squared() <= range_m * range_m);
    }

    /// The nearest point among the voxel of `point` and its 26 neighbours, if it is nearer than `max_m`.
    pub(super) fn nearest(&self, point: &Point3<f64>, max_m: f64) -> Option<Point3<f64>> {
        let per_m = 1.0 / self.voxel_m;
        let center = indices(point, per_m);
        let mut best_m2 = max_m * max_m;
        let mut best = None;
        // Squared distances to the lower neighbour, the own voxel and the upper neighbour along each axis.
        let gaps: [[f64; 3]; 3] = std::array::from_fn(|axis| {
            let inside = point[axis] - center[axis] as f64 * self.voxel_m;
            [inside * inside, 0.0, (self.voxel_m - inside).powi(2)]
        });
        // The own voxel first: what it has makes most of the others too far.
        for dx in [1, 0, 2] {
            for dy in [1, 0, 2] {
                for dz in [1, 0, 2] {
                    if gaps[0][dx] + gaps[1][dy] + gaps[2][dz] >= best_m2 {
                        continue;
                    }
                    let [x, y, z] = [dx, dy, dz].map(|d| d as i64 - 1);
                    let Some(points) = self.voxels.get(&key([center[0] + x, center[1] + y, center[2] + z])) else {
                        continue;
                    };
                    for other in points {
                        let distance_m2 = (other - point).norm_squared();
                        if distance_m2 < best_m2 {
                            (best_m2, best) = (distance_m2, Some(*other));
                        }
                    }
                }
            }
        }
        best
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn points(values: &[[f64; 3]]) -> Vec<Point3<f64>> {
        values.iter().map(|v| Point3::from(*v)).collect()
    }

    proptest! {
        #[test]
        fn nearest_is_that_of_a_search_through_all(
            map in prop::collection::vec(prop::array::uniform3(-3.0..3.0), 1..100),
            at in prop::array::uniform3(-3.0..3.0),
            max_m in 0.1..1.0,
        ) {
            let (map, at) = (points(&map), Point3::from(at));
            let mut voxels = VoxelMap::new(1.0, 1000);
            voxels.apart_m2 = 0.0;
            voxels.add(map.iter().copied());
            let distance = |p: &Point3<f64>| (p - at).norm();
            let want = map.iter().map(distance).filter(|d| *d < max_m).min_by(f64::total_cmp);
            let got = voxels.nearest(&at, max_m).map(|p| distance(&p));
            prop_assert_eq!(got, want);
        }

        #[test]
        fn a_thinned_cloud_has_one_point_in_a_voxel(cloud in prop::collection::vec(prop::array::uniform3(-2.0..2.0), 0..80)) {
            let cloud = points(&cloud);
            let thinned = thin(&cloud, 0.7);
            let keys: HashSet<_> = thinned.iter().map(|p| indices(p, 1.0 / 0.7)).collect();
            let all: HashSet<_> = cloud.iter().map(|p| indices(p, 1.0 / 0.7)).collect();
            prop_assert_eq!(keys.len(), thinned.len());
            prop_assert_eq!(keys, all);
        }
    }

    #[test]
    fn voxels_are_full_at_their_limit_and_removed_far_away() {
        let mut map = VoxelMap::new(1.0, 2);
        map.add(
            points(&[[0.1, 0.1, 0.1], [0.2, 0.1, 0.1], [0.9, 0.9, 0.9], [0.9, 0.1, 0.1], [7.0, 0.0, 0.0]]).into_iter(),
        );
        let at = |x, y, z| map.nearest(&Point3::new(x, y, z), 0.05).is_some();
        assert!(at(0.1, 0.1, 0.1) && at(0.9, 0.9, 0.9) && at(7.0, 0.0, 0.0));
        assert!(!at(0.2, 0.1, 0.1), "too near to the first");
        assert!(!at(0.9, 0.1, 0.1), "the voxel is full");
        map.remove_far(&Point3::origin(), 5.0);
        assert!(map.nearest(&Point3::new(7.0, 0.0, 0.0), 1.0).is_none() && map.voxels.len() == 1);
    }
}
