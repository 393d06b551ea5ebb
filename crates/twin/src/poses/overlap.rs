//! How well scans coincide at given poses: the voxels that they fill together.

use crate::odometry::voxels::{Key, KeyHasher, indices, key, thin};
use geometry::Pose;
use nalgebra::Point3;
use rayon::prelude::*;
use std::collections::{HashMap, HashSet};
use std::hash::BuildHasherDefault;

/// Side of a voxel, m: wider than the errors of a GPS between neighbouring scans.
const VOXEL_M: f64 = 0.4;

/// Scans are thinned to this, m.
const THIN_M: f64 = 0.2;

/// Points nearer than this are not used, m: the ego vehicle, which is the same in all scans.
const NEAREST_M: f64 = 3.0;

/// Points farther than this are not used, m: there a small turn moves them by a voxel.
const FARTHEST_M: f64 = 40.0;

/// Points stand on something upright if those of their column of voxels differ by this in height, m.
const UPRIGHT_M: f64 = 0.5;

/// The points of a scan that are compared: those on upright things. The rings of a sensor on level ground lie at the
/// same places of each scan, wherever it is, and would coincide without any motion.
pub(super) fn prepared(scan: &[[f32; 3]]) -> Vec<Point3<f64>> {
    let points = scan.iter().map(|p| Point3::from(p.map(f64::from)));
    let near: Vec<_> = points.filter(|p| (NEAREST_M..=FARTHEST_M).contains(&p.coords.norm())).collect();
    let column = |p: &Point3<f64>| {
        let [x, y, _] = indices(p, 1.0 / VOXEL_M);
        key([x, y, 0])
    };
    let mut heights: HashMap<Key, [f64; 2], BuildHasherDefault<KeyHasher>> = HashMap::default();
    for p in &near {
        let [low, high] = heights.entry(column(p)).or_insert([p.z; 2]);
        (*low, *high) = (low.min(p.z), high.max(p.z));
    }
    let upright = |p: &&Point3<f64>| heights.get(&column(p)).is_some_and(|[low, high]| high - low > UPRIGHT_M);
    let kept: Vec<_> = near.iter().filter(upright).copied().collect();
    thin(&kept, THIN_M)
}

/// The number of voxels that scans fill together, as a share of the sum of what each fills: 1 if they have nothing in
/// common, one divided by their number if they coincide. Smaller is sharper.
pub(super) fn spread(scans: &[Vec<Point3<f64>>], world_from_lidar: &[Pose]) -> f64 {
    let filled = |(scan, pose): (&Vec<Point3<f64>>, &Pose)| {
        let voxel = |p: &Point3<f64>| key(indices(&(pose * p), 1.0 / VOXEL_M));
        scan.iter().map(voxel).collect::<HashSet<Key, BuildHasherDefault<KeyHasher>>>()
    };
    let each: Vec<_> = scans.par_iter().zip(world_from_lidar).map(filled).collect();
    let sum: usize = each.iter().map(HashSet::len).sum();
    let mut union = HashSet::<Key, BuildHasherDefault<KeyHasher>>::default();
    each.into_iter().for_each(|voxels| union.extend(voxels));
    union.len() as f64 / sum.max(1) as f64
}
