//! Which convention the poses of a recording follow.

use super::overlap::{prepared, spread};
use geometry::Pose;
use nalgebra::{Matrix3, Matrix4, Rotation3, UnitQuaternion, Vector3};
use std::fmt;

/// A way to make `world_from_lidar` of poses that follow another convention.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Convention {
    /// The poses are `world_from_lidar`.
    AsGiven,
    /// The poses are `lidar_from_world`.
    Inverse,
    /// The poses are those of a camera frame: x right, y down, z forward.
    Camera,
    /// The poses are the inverse of those of a camera frame.
    InverseCamera,
    /// The poses are those of a frame with x right and y forward.
    RightForward,
    /// The poses are the inverse of those of a frame with x right and y forward.
    InverseRightForward,
    /// The poses and the clouds have unlike handedness: y points to the other side.
    Mirrored,
    /// The poses are the inverse of those of a frame with the other handedness.
    InverseMirrored,
    /// Angles in rad were taken as degrees: the rotations are too small by a factor of 57.3.
    RadiansAsDegrees,
}

impl Convention {
    /// All conventions.
    pub const ALL: [Convention; 9] = [
        Convention::AsGiven,
        Convention::Inverse,
        Convention::Camera,
        Convention::InverseCamera,
        Convention::RightForward,
        Convention::InverseRightForward,
        Convention::Mirrored,
        Convention::InverseMirrored,
        Convention::RadiansAsDegrees,
    ];

    /// `world_from_lidar` of poses that follow this convention. Poses of a frame with other axes may have a world with
    /// the same axes or one with z up: the one in which the LiDAR stands upright is taken.
    pub fn world_from_lidar(self, given: &[Pose]) -> Vec<Pose> {
        let inverse = || given.iter().map(Pose::inverse).collect::<Vec<_>>();
        match self {
            Convention::AsGiven => given.to_vec(),
            Convention::Inverse => inverse(),
            Convention::Camera => turned(given, &LIDAR_FROM_CAMERA),
            Convention::InverseCamera => turned(&inverse(), &LIDAR_FROM_CAMERA),
            Convention::RightForward => turned(given, &LIDAR_FROM_RIGHT_FORWARD),
            Convention::InverseRightForward => turned(&inverse(), &LIDAR_FROM_RIGHT_FORWARD),
            Convention::Mirrored => given.iter().map(mirrored).collect(),
            Convention::InverseMirrored => inverse().iter().map(mirrored).collect(),
            Convention::RadiansAsDegrees => given.iter().map(widened).collect(),
        }
    }
}

impl fmt::Display for Convention {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Convention::AsGiven => "as given (LiDAR to world)",
            Convention::Inverse => "inverse (world to LiDAR)",
            Convention::Camera => "camera axes (x right, y down, z forward)",
            Convention::InverseCamera => "inverse, camera axes (x right, y down, z forward)",
            Convention::RightForward => "x right, y forward",
            Convention::InverseRightForward => "inverse, x right, y forward",
            Convention::Mirrored => "other handedness (y to the other side)",
            Convention::InverseMirrored => "inverse, other handedness (y to the other side)",
            Convention::RadiansAsDegrees => "angles in rad that were taken as degrees",
        })
    }
}

/// The axes of a frame: the matrix that turns it into the LiDAR frame, row by row.
type Axes = [[f64; 3]; 3];

const LIDAR_FROM_CAMERA: Axes = [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]];
const LIDAR_FROM_RIGHT_FORWARD: Axes = [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]];

fn rotation(axes: &Axes) -> UnitQuaternion<f64> {
    let matrix = Matrix3::from_fn(|row, column| axes[row][column]);
    UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(matrix))
}

/// Poses of a frame with other axes, as poses of the LiDAR.
fn turned(given: &[Pose], lidar_from_axes: &Axes) -> Vec<Pose> {
    let axes = rotation(lidar_from_axes);
    let turn =
        |world: UnitQuaternion<f64>| given.iter().map(|pose| world * pose * axes.inverse()).collect::<Vec<Pose>>();
    let upright = |poses: &[Pose]| poses.iter().map(|pose| (pose.rotation * Vector3::z()).z).sum::<f64>();
    let (kept, both) = (turn(UnitQuaternion::identity()), turn(axes));
    if upright(&kept) > upright(&both) + 1e-6 { kept } else { both }
}

/// A pose of frames whose y axes point to the other side.
fn mirrored(pose: &Pose) -> Pose {
    let mirror = Matrix4::from_diagonal(&[1.0, -1.0, 1.0, 1.0].into());
    let matrix = mirror * pose.to_homogeneous() * mirror;
    let rotation = Rotation3::from_matrix_unchecked(matrix.fixed_view::<3, 3>(0, 0).into_owned());
    let translation = matrix.fixed_view::<3, 1>(0, 3).into_owned();
    Pose::from_parts(translation.into(), UnitQuaternion::from_rotation_matrix(&rotation))
}

/// A pose with a rotation that is larger by the number of degrees of a radian.
fn widened(pose: &Pose) -> Pose {
    let rotation = UnitQuaternion::from_scaled_axis(pose.rotation.scaled_axis().map(f64::to_degrees));
    Pose::from_parts(pose.translation, rotation)
}

/// How sharp scans become under one convention.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Candidate {
    /// The convention.
    pub convention: Convention,
    /// The number of voxels of 0.4 m that the scans fill together, as a share of the sum of what each fills. Smaller is
    /// sharper.
    pub spread: f64,
}

/// What the scans say of the poses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// The poses are right as they are, or no other convention is sharper.
    AsGiven,
    /// Another convention is sharper.
    Other(Convention),
    /// The scans are sharper without any motion than under each convention: the poses are of no use.
    None,
    /// The vehicle hardly moved, hardly anything stands around it, or there are fewer than two scans: nothing can be
    /// said.
    Unknown,
}

/// The evidence of [`find_convention`].
#[derive(Clone, Debug, PartialEq)]
pub struct ConventionReport {
    /// What follows.
    pub verdict: Verdict,
    /// All conventions, the sharpest first.
    pub candidates: Vec<Candidate>,
    /// The same measure as if the vehicle had stood still.
    pub without_motion: f64,
    /// Places of the scans that were compared, in the order in which they were given.
    pub compared: Vec<usize>,
}

impl fmt::Display for ConventionReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let given = self.candidates.iter().find(|c| c.convention == Convention::AsGiven);
        let given = given.map_or(f64::NAN, |c| c.spread);
        let best = self.candidates.first().map_or(f64::NAN, |c| c.spread);
        let (scans, still) = (self.compared.len(), self.without_motion);
        match self.verdict {
            Verdict::AsGiven => write!(
                f,
                "the poses fit as they are given: {scans} scans fill {given:.3} of their voxels, {still:.3} without \
                 motion"
            ),
            Verdict::Other(convention) => write!(
                f,
                "the poses fit another convention, {convention}: {scans} scans fill {best:.3} of their voxels so, \
                 {given:.3} as given, {still:.3} without motion"
            ),
            Verdict::None => write!(
                f,
                "the poses fit no known convention: {scans} scans fill {still:.3} of their voxels without motion and \
                 {best:.3} at best with it; find others by the odometry"
            ),
            Verdict::Unknown => f.write_str(
                "the scans say nothing of the poses: the vehicle hardly moved, or hardly anything stands around it",
            ),
        }
    }
}

/// Scans that are compared.
const MOST_SCANS: usize = 6;

/// Path and turn between scans that are compared.
const STEP_M: f64 = 2.0;
const STEP_RAD: f64 = 0.05;

/// Another convention must be sharper than the given one by this share.
const LEAST_GAIN: f64 = 0.02;

/// No motion must be sharper than the best convention by this share: along even walls both are alike.
const STILL_GAIN: f64 = 0.05;

/// Points on upright things, thinned, that each scan needs.
const FEWEST_POINTS: usize = 100;

/// Finds the convention under which scans fit together.
///
/// `scans` are clouds in the LiDAR frame (x forward, y left, z up), m; `given` are their poses. Up to six scans that
/// are about 2 m apart are compared, from the middle of the recording on. On a straight road, conventions with the same
/// direction of travel are alike; the given one is preferred.
///
/// # Panics
/// There are not as many poses as scans.
pub fn find_convention<S: AsRef<[[f32; 3]]> + Sync>(scans: &[S], given: &[Pose]) -> ConventionReport {
    assert_eq!(scans.len(), given.len(), "as many poses as scans");
    let compared = compared(given);
    let clouds: Vec<_> = compared.iter().map(|i| prepared(scans[*i].as_ref())).collect();
    let given: Vec<Pose> = compared.iter().map(|i| given[*i]).collect();
    let of = |convention: Convention| {
        let poses = convention.world_from_lidar(&given);
        // The grid of voxels is laid into the first scan, for all conventions alike.
        let first = poses.first().map_or_else(Pose::identity, Pose::inverse);
        let poses: Vec<Pose> = poses.iter().map(|pose| first * pose).collect();
        Candidate { convention, spread: spread(&clouds, &poses) }
    };
    let mut candidates: Vec<Candidate> = Convention::ALL.into_iter().map(of).collect();
    let given_spread = candidates[0].spread;
    candidates.sort_by(|a, b| a.spread.total_cmp(&b.spread));
    let without_motion = spread(&clouds, &vec![Pose::identity(); clouds.len()]);
    let best = candidates[0];
    let verdict = if compared.len() < 2 || clouds.iter().any(|cloud| cloud.len() < FEWEST_POINTS) {
        Verdict::Unknown
    } else if without_motion * (1.0 + STILL_GAIN) < best.spread {
        Verdict::None
    } else if given_spread <= best.spread * (1.0 + LEAST_GAIN) {
        Verdict::AsGiven
    } else {
        Verdict::Other(best.convention)
    };
    ConventionReport { verdict, candidates, without_motion, compared }
}

/// The places of scans that are apart in position or direction, from the middle of the recording on, and if these are
/// too few from its start: those that [`find_convention`] compares.
pub fn compared(poses: &[Pose]) -> Vec<usize> {
    let from = |start: usize| {
        let mut chosen: Vec<usize> = Vec::new();
        for (i, pose) in poses.iter().enumerate().skip(start) {
            let apart = |last: &usize| {
                let step = poses[*last].inverse() * pose;
                step.translation.vector.norm() > STEP_M || step.rotation.angle() > STEP_RAD
            };
            if chosen.len() < MOST_SCANS && chosen.last().is_none_or(apart) {
                chosen.push(i);
            }
        }
        chosen
    };
    let middle = from(poses.len() / 2);
    if middle.len() == MOST_SCANS { middle } else { from(0) }
}

#[cfg(test)]
mod tests;
