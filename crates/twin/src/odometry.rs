//! Poses from clouds alone: KISS-ICP (Vizzo et al. 2023, "KISS-ICP: In Defense of Point-to-Point ICP", RA-L 8(2)),
//! and the refinement of given poses.
//!
//! A scan is predicted with a constant velocity, freed of the motion of the sensor where its points have times, thinned
//! twice, and aligned to a local map of voxels, point to point, with a robust kernel. How far a point may be from its
//! neighbour in the map follows from how wrong the predictions were so far.
//!
//! The same clouds give the same bits for any number of threads.

mod motion;
mod refine;
mod registration;
mod surface_map;
pub(crate) mod voxels;

pub use motion::{exp, log};
pub use refine::{RefineConfig, Refined, refine};
pub use surface_map::{Sharpness, SurfaceMap};

use geometry::Pose;
use nalgebra::Point3;
use registration::{Registration, align};
use voxels::{VoxelMap, thin};

/// Parameters of [`Odometry`], with the values of KISS-ICP as defaults.
#[derive(Clone, Debug, PartialEq)]
pub struct OdometryConfig {
    /// Points farther than this are not used, and the map reaches as far, m.
    pub max_range_m: f64,
    /// Points nearer than this are not used, m: the ego vehicle.
    pub min_range_m: f64,
    /// Side of a voxel of the map, m. KISS-ICP: a hundredth of the largest range.
    pub voxel_m: f64,
    /// Most points of a voxel of the map.
    pub points_per_voxel: usize,
    /// Deviation of a scan from its prediction that is assumed at first, m.
    pub initial_deviation_m: f64,
    /// Deviations below this say nothing of the predictions, m.
    pub min_deviation_m: f64,
    /// Most iterations of the alignment of a scan.
    pub max_iterations: usize,
    /// The alignment ends with a step below this, m and rad.
    pub least_step: f64,
}

impl Default for OdometryConfig {
    fn default() -> Self {
        OdometryConfig {
            max_range_m: 100.0,
            min_range_m: 0.0,
            voxel_m: 1.0,
            points_per_voxel: 20,
            initial_deviation_m: 2.0,
            min_deviation_m: 0.1,
            max_iterations: 500,
            least_step: 1e-4,
        }
    }
}

/// Takes clouds one after the other and returns the pose of each.
#[derive(Clone, Debug)]
pub struct Odometry {
    config: OdometryConfig,
    map: VoxelMap,
    world_from_last: Option<Pose>,
    /// The pose of the last scan in the frame of the one before: the prediction of the next motion.
    last_motion: Pose,
    deviations: Deviations,
}

impl Odometry {
    /// An odometry without scans. The first scan is at the origin of the world.
    pub fn new(config: OdometryConfig) -> Self {
        let map = VoxelMap::new(config.voxel_m, config.points_per_voxel);
        let deviations = Deviations { sum_m2: config.initial_deviation_m.powi(2), count: 1 };
        Odometry { config, map, world_from_last: None, last_motion: Pose::identity(), deviations }
    }

    /// Adds a cloud and returns `world_from_lidar` at its time stamp.
    ///
    /// `points` are in the LiDAR frame, m; points that are not finite are left out. `times_s` has the time of each
    /// point relative to the time stamp, s, if the cloud still has the motion of the sensor in it; `None` if there are
    /// no times or the cloud has been compensated. One turn of the sensor is assumed to last as long as the times span.
    ///
    /// # Panics
    /// `times_s` has another length than `points`.
    pub fn add(&mut self, points: &[[f32; 3]], times_s: Option<&[f32]>) -> Pose {
        let points = self.preprocess(points, times_s);
        let dense = thin(&points, 0.5 * self.config.voxel_m);
        let sparse = thin(&dense, 1.5 * self.config.voxel_m);
        let predicted = self.world_from_last.map_or_else(Pose::identity, |last| last * self.last_motion);
        let sigma_m = self.deviations.sigma_m();
        let found = if self.map.is_empty() {
            predicted
        } else {
            let registration = Registration {
                max_distance_m: 3.0 * sigma_m,
                kernel_m2: sigma_m,
                max_iterations: self.config.max_iterations,
                least_step: self.config.least_step,
            };
            align(&sparse, &self.map, &predicted, &registration)
        };
        self.deviations.add(&(predicted.inverse() * found), &self.config);
        self.map.add(dense.iter().map(|p| found * p));
        self.map.remove_far(&found.translation.vector.into(), self.config.max_range_m);
        self.last_motion = self.world_from_last.map_or_else(Pose::identity, |last| last.inverse() * found);
        self.world_from_last = Some(found);
        found
    }

    /// The points within the ranges, moved to where they were at the time stamp.
    fn preprocess(&self, points: &[[f32; 3]], times_s: Option<&[f32]>) -> Vec<Point3<f64>> {
        if let Some(times) = times_s {
            assert_eq!(times.len(), points.len(), "as many times as points");
        }
        let (min, max) = (self.config.min_range_m, self.config.max_range_m);
        let all = times_s.unwrap_or_default().iter().copied().filter(|t| t.is_finite());
        let (first, last) = all.fold((f32::INFINITY, f32::NEG_INFINITY), |(a, b), t| (a.min(t), b.max(t)));
        let span_s = if last > first { f64::from(last - first) } else { f64::INFINITY };
        let twist = log(&self.last_motion);
        let moved = |(i, point): (usize, &[f32; 3])| {
            let p = Point3::from(point.map(f64::from));
            let range = p.coords.norm();
            if !(range >= min && range <= max) {
                return None;
            }
            let time_s = times_s.map_or(0.0, |times| f64::from(times[i]));
            if time_s == 0.0 {
                return Some(p);
            }
            time_s.is_finite().then(|| exp(&(twist * (time_s / span_s))) * p)
        };
        points.iter().enumerate().filter_map(moved).collect()
    }
}

/// How far scans were from their predictions.
#[derive(Clone, Debug)]
struct Deviations {
    sum_m2: f64,
    count: usize,
}

impl Deviations {
    fn sigma_m(&self) -> f64 {
        (self.sum_m2 / self.count as f64).sqrt()
    }

    /// A rotation counts as the path of a point at the largest range.
    fn add(&mut self, deviation: &Pose, config: &OdometryConfig) {
        let turned_m = 2.0 * config.max_range_m * (deviation.rotation.angle() / 2.0).sin();
        let error_m = turned_m + deviation.translation.vector.norm();
        if error_m > config.min_deviation_m {
            self.sum_m2 += error_m * error_m;
            self.count += 1;
        }
    }
}

#[cfg(test)]
mod tests;
