//! The refinement of given poses: each scan is aligned to the planes that all other scans show.
//!
//! The moments of the points in each voxel are summed over all scans. Those of the scan itself are taken out before its
//! planes are made, so that no scan is held against itself.

use super::registration::{geman_mcclure, moved, sum_of_equations};
use super::surface_map::{Sharpness, SurfaceMap};
use super::voxels::thin;
use geometry::Pose;
use nalgebra::Point3;
use rayon::prelude::*;

/// Offsets of the voxels in successive rounds, in voxels.
const OFFSETS: [f64; 4] = [0.0, 0.5, 0.25, 0.75];

/// Parameters of [`refine`].
#[derive(Clone, Debug, PartialEq)]
pub struct RefineConfig {
    /// Points farther than this are not used, m.
    pub max_range_m: f64,
    /// Points nearer than this are not used, m: the ego vehicle.
    pub min_range_m: f64,
    /// Sides of the voxels of the map, m: a round for each. Wide voxels correct wrong poses, narrow ones small errors.
    pub voxels_m: Vec<f64>,
    /// Scans are thinned to one point in a voxel of this side, m.
    pub thin_m: f64,
    /// Scale of the kernel, m: a distance of this size from a plane has a quarter of the weight.
    pub kernel_m: f64,
    /// Steps of each scan in each round.
    pub steps: usize,
}

impl Default for RefineConfig {
    fn default() -> Self {
        RefineConfig {
            max_range_m: 80.0,
            min_range_m: 2.0,
            voxels_m: vec![1.0, 1.0, 1.0, 1.0, 0.5, 0.5, 0.5, 0.5],
            thin_m: 0.1,
            kernel_m: 0.1,
            steps: 5,
        }
    }
}

/// Refined poses and what they changed.
#[derive(Clone, Debug, PartialEq)]
pub struct Refined {
    /// `world_from_lidar` of each scan. The first pose is as it was given.
    pub poses: Vec<Pose>,
    /// Sharpness of the surfaces with the given poses, in voxels of the last round; `None` if the scans share too
    /// little.
    pub before: Option<Sharpness>,
    /// Sharpness of the surfaces with the refined poses.
    pub after: Option<Sharpness>,
    /// Largest distance between a given and a refined position, m.
    pub farthest_m: f64,
}

/// Refines the poses of scans whose poses are right to about half a metre and a degree.
///
/// `scans` are points in the LiDAR frame, m, freed of the motion of the sensor; `world_from_lidar` are their poses.
///
/// # Panics
/// There are not as many poses as scans, or no round.
pub fn refine<S: AsRef<[[f32; 3]]> + Sync>(scans: &[S], world_from_lidar: &[Pose], config: &RefineConfig) -> Refined {
    assert_eq!(scans.len(), world_from_lidar.len(), "as many poses as scans");
    let last_m = *config.voxels_m.last().expect("at least one round");
    let in_range = |p: &Point3<f64>| (config.min_range_m..=config.max_range_m).contains(&p.coords.norm());
    let thinned = |scan: &S| {
        let points = scan.as_ref().iter().map(|p| Point3::from(p.map(f64::from)));
        thin(&points.filter(in_range).collect::<Vec<_>>(), config.thin_m)
    };
    let scans: Vec<Vec<Point3<f64>>> = scans.par_iter().map(thinned).collect();
    let before = SurfaceMap::new(&scans, world_from_lidar, last_m, 0.0).sharpness();
    let mut poses = world_from_lidar.to_vec();
    for (round, voxel_m) in config.voxels_m.iter().enumerate() {
        let map = SurfaceMap::new(&scans, &poses, *voxel_m, OFFSETS[round % OFFSETS.len()]);
        let mut found: Vec<Pose> =
            scans.par_iter().zip(&poses).map(|(scan, pose)| align_to_planes(scan, &map, pose, config)).collect();
        if let (Some(first), Some(given)) = (found.first().copied(), world_from_lidar.first()) {
            let back = given * first.inverse();
            found.iter_mut().for_each(|pose| *pose = back * *pose);
        }
        poses = found;
    }
    let after = SurfaceMap::new(&scans, &poses, last_m, 0.0).sharpness();
    let distance = |(a, b): (&Pose, &Pose)| (a.translation.vector - b.translation.vector).norm();
    let farthest_m = poses.iter().zip(world_from_lidar).map(distance).fold(0.0, f64::max);
    Refined { poses, before, after, farthest_m }
}

/// The pose at which a scan of the map fits best to the planes of the other scans. Without planes that hold it, the
/// pose stays.
fn align_to_planes(scan: &[Point3<f64>], map: &SurfaceMap, start: &Pose, config: &RefineConfig) -> Pose {
    let planes = map.planes_of_others(scan, start);
    let mut pose = *start;
    for _ in 0..config.steps {
        let center = pose.translation.vector;
        let equations = sum_of_equations(scan, |equations, p| {
            let p = pose * p;
            let Some(plane) = planes.at(&p) else { return };
            let distance_m = plane.normal.dot(&(p - plane.mean));
            let weight = geman_mcclure(distance_m * distance_m, config.kernel_m * config.kernel_m);
            equations.add_plane(&(p - center), &plane.normal, distance_m, weight);
        });
        let Some(step) = equations.solve() else { return pose };
        pose = moved(&pose, &step);
    }
    pose
}
