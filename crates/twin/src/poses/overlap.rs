//! How well scans coincide at given poses: the voxels that they fill together.

use crate::odometry::voxels::{Key, KeyHasher, indices, key, thin};
use geometry::Pose;
use nalgebra::Point3;
use rayon::prelude::*;
use std::collections::HashSet;
use std::hash::BuildHasherDefault;

/// Side of a voxel, m: wider than the errors of a GPS between neighbouring scans.
const VOXEL_M: f64 = 0.4;

/// Scans are thinned to this, m.
const THIN_M: f64 = 0.2;

/// Points nearer than this are not used, m: the ego vehicle, which is the same in all scans.
const NEAREST_M: f64 = 3.0;

/// Points farther than this are not used, m: there a small turn moves them by a voxel.
const FARTHEST_M: f64 = 40.0;

/// The points of a scan that are compared.
pub(super) fn prepared(scan: &[[f32; 3]]) -> Vec<Point3<f64>> {
    let points = scan.iter().map(|p| Point3::from(p.map(f64::from)));
    let near: Vec<_> = points.filter(|p| (NEAREST_M..=FARTHEST_M).contains(&p.coords.norm())).collect();
    thin(&near, THIN_M)
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
