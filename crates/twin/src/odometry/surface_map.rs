//! Planes in voxels: the moments of all points of several scans, from which those of one scan can be taken out.

use super::voxels::{ByVoxel, indices, key};
use geometry::Pose;
use nalgebra::{Matrix3, Point3, Vector3};
use rayon::prelude::*;

/// Points that a voxel needs for a plane.
const FEWEST_POINTS: f64 = 8.0;

/// A voxel is a plane if the smallest spread is below this share of the middle one.
const MOST_FLATNESS: f64 = 0.25;

/// A plane is a wall if its normal rises less than this (about 17 degrees).
const WALL_RISE: f64 = 0.3;

/// Scans that must have seen a voxel before it says how sharp the map is.
const SHARED_BY: u32 = 3;

/// Sums over the points of a voxel, about its lower corner.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Moments {
    count: f64,
    sum: Vector3<f64>,
    products: Matrix3<f64>,
    scans: u32,
}

/// A plane in a voxel.
#[derive(Clone, Copy, Debug)]
pub(super) struct Plane {
    /// Mean of its points, m, world.
    pub mean: Point3<f64>,
    /// Unit normal, world.
    pub normal: Vector3<f64>,
    /// Standard deviation of the points along the normal, m.
    pub thickness_m: f64,
    /// Standard deviation along the shorter of the two other axes, m.
    width_m: f64,
}

impl Moments {
    fn add(&mut self, from_corner: &Vector3<f64>) {
        self.count += 1.0;
        self.sum += from_corner;
        self.products += from_corner * from_corner.transpose();
    }

    fn plus(&mut self, other: &Moments) {
        self.count += other.count;
        self.sum += other.sum;
        self.products += other.products;
        self.scans += other.scans;
    }

    fn minus(mut self, other: &Moments) -> Moments {
        self.count -= other.count;
        self.sum -= other.sum;
        self.products -= other.products;
        self
    }

    /// The plane through the points; `None` for too few points and for points that are no plane.
    fn plane(&self, corner: &Point3<f64>) -> Option<Plane> {
        self.axes(corner).filter(|plane| plane.thickness_m < MOST_FLATNESS * plane.width_m)
    }

    /// The axes of the points, whether they are a plane or not.
    fn axes(&self, corner: &Point3<f64>) -> Option<Plane> {
        if self.count < FEWEST_POINTS {
            return None;
        }
        let mean = self.sum / self.count;
        let axes = (self.products / self.count - mean * mean.transpose()).symmetric_eigen();
        let mut order = [0, 1, 2];
        order.sort_by(|a, b| axes.eigenvalues[*a].total_cmp(&axes.eigenvalues[*b]));
        let spread = |i: usize| axes.eigenvalues[order[i]].max(0.0).sqrt();
        let normal = axes.eigenvectors.column(order[0]).into_owned();
        Some(Plane { mean: corner + mean, normal, thickness_m: spread(0), width_m: spread(1) })
    }
}

/// How sharp the surfaces are that several scans show together.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sharpness {
    /// Median thickness of the walls: the standard deviation of their points along the normal, m.
    pub wall_thickness_m: f64,
    /// Voxels in which there is a wall that at least three scans show.
    pub walls: usize,
    /// Share of planes among all voxels that at least three scans show.
    pub planar_share: f64,
}

/// Steps to the voxels that share a side with a voxel.
const NEIGHBOURS: [[i64; 3]; 6] = [[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]];

/// Planes in voxels.
pub(super) struct Planes {
    voxels: ByVoxel<Plane>,
    voxel_m: f64,
    offset_m: f64,
}

impl Planes {
    /// The plane in the voxel of a point; without one, that behind the nearest side of the voxel. A surface that lies
    /// on a side of voxels would else hold points from one side only.
    pub(super) fn at(&self, point: &Point3<f64>) -> Option<&Plane> {
        let per_m = 1.0 / self.voxel_m;
        let inside = point.map(|v| (v + self.offset_m) * per_m);
        let mut at = indices(&inside, 1.0);
        if let Some(plane) = self.voxels.get(&key(at)) {
            return Some(plane);
        }
        let from_center = |axis: usize| inside[axis] - at[axis] as f64 - 0.5;
        let axis = [1, 2].into_iter().fold(0, |a, b| if from_center(b).abs() > from_center(a).abs() { b } else { a });
        at[axis] += if from_center(axis) < 0.0 { -1 } else { 1 };
        self.voxels.get(&key(at))
    }
}

/// The moments of the points of several scans in voxels.
#[derive(Clone, Debug)]
pub struct SurfaceMap {
    voxels: ByVoxel<([i64; 3], Moments)>,
    voxel_m: f64,
    /// How far the corners of the voxels are moved along each axis, m.
    offset_m: f64,
}

impl SurfaceMap {
    /// The map of scans (points in the LiDAR frame, m) at their poses. `voxel_m` is the side of a voxel. The corners of
    /// the voxels are moved by `offset`, in voxels: maps with unlike offsets cut surfaces at unlike places.
    pub fn new<S>(scans: &[S], world_from_lidar: &[Pose], voxel_m: f64, offset: f64) -> Self
    where
        S: AsRef<[Point3<f64>]> + Sync,
    {
        let mut map = SurfaceMap { voxels: ByVoxel::default(), voxel_m, offset_m: offset * voxel_m };
        // A few scans at a time: memory grows with the extent of the map, not with the number of scans.
        let both: Vec<(&S, &Pose)> = scans.iter().zip(world_from_lidar).collect();
        for some in both.chunks(16) {
            let of_scans: Vec<_> = some.par_iter().map(|(scan, pose)| map.of_scan(scan.as_ref(), pose)).collect();
            for of_scan in of_scans {
                // Each voxel occurs once a scan: the order within a scan changes nothing.
                for (key, (indices, moments)) in of_scan {
                    map.voxels.entry(key).or_insert((indices, Moments::default())).1.plus(&moments);
                }
            }
        }
        map
    }

    fn of_scan(&self, scan: &[Point3<f64>], pose: &Pose) -> ByVoxel<([i64; 3], Moments)> {
        let mut voxels: ByVoxel<([i64; 3], Moments)> = ByVoxel::default();
        for point in scan {
            let point = pose * point;
            let at = indices(&point.map(|v| v + self.offset_m), 1.0 / self.voxel_m);
            let (_, moments) = voxels.entry(key(at)).or_insert((at, Moments { scans: 1, ..Moments::default() }));
            moments.add(&(point - self.corner(at)));
        }
        voxels
    }

    fn corner(&self, indices: [i64; 3]) -> Point3<f64> {
        Point3::from(indices.map(|i| i as f64 * self.voxel_m - self.offset_m))
    }

    /// The planes of all other scans around a scan of this map, which is at the pose that it has in the map.
    pub(super) fn planes_of_others(&self, scan: &[Point3<f64>], pose: &Pose) -> Planes {
        let own = self.of_scan(scan, pose);
        let mut around: ByVoxel<Option<Plane>> = ByVoxel::default();
        for (at, _) in own.values() {
            for next in std::iter::once(*at).chain(NEIGHBOURS.map(|step| [0, 1, 2].map(|axis| at[axis] + step[axis]))) {
                around.entry(key(next)).or_insert_with(|| {
                    let (_, all) = self.voxels.get(&key(next))?;
                    let others = own.get(&key(next)).map_or(*all, |(_, own)| all.minus(own));
                    others.plane(&self.corner(next))
                });
            }
        }
        let voxels = around.into_iter().filter_map(|(key, plane)| Some((key, plane?))).collect();
        Planes { voxels, voxel_m: self.voxel_m, offset_m: self.offset_m }
    }

    /// How sharp the surfaces are; `None` if no voxel was seen by three scans.
    pub fn sharpness(&self) -> Option<Sharpness> {
        let shared = self.voxels.values().filter(|(_, moments)| moments.scans >= SHARED_BY);
        let axes: Vec<Plane> = shared.filter_map(|(at, moments)| moments.axes(&self.corner(*at))).collect();
        let planes: Vec<&Plane> = axes.iter().filter(|p| p.thickness_m < MOST_FLATNESS * p.width_m).collect();
        let walls = planes.iter().filter(|plane| plane.normal.z.abs() < WALL_RISE);
        let thickness: Vec<f64> = walls.map(|plane| plane.thickness_m).collect();
        let walls = thickness.len();
        Some(Sharpness {
            wall_thickness_m: statistics::median_upper(thickness)?,
            walls,
            planar_share: planes.len() as f64 / axes.len() as f64,
        })
    }
}
