//! Distances of measured returns from the simulated surfaces, across them, as sums from which every linear cause is
//! fitted. Each frame has a small pose error of its own, which is integrated out.
//!
//! A movement of the scene by `delta` brings a surface with normal n (towards the sensor) nearer by n . delta.

use crate::channels::moments::{COURSES, Moment, Moments};
use crate::channels::own_poses::{Mount, OwnPoses, mounts, off_surface_m};
use crate::inference::median;
use crate::pairing::{FramePair, Ray, Surface, met_squarely};
use nalgebra::{DMatrix, DVector, Point3, SVector, Vector3};
use rayon::prelude::*;
use sensor::{Rig, Sensor};

/// A linear cause: one column of the fit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Column {
    /// An offset of all ranges, m.
    RangeOffset,
    /// A share of the range.
    RangeScale,
    /// Pose of the scene in the cloud's frame: turns about x, y, z (rad), then shifts (m).
    Pose(usize),
    /// The same for what one sensor sees, about its own origin and in the cloud's axes.
    SensorPose(usize, usize),
    /// A shift along x, y or a turn about z that grows over a scan from -1/2 to +1/2.
    Sweep(usize),
    /// Duration of a scan, s: what stands still moves by the ego motion of its frame.
    Scan,
    /// The same by how unevenly the scan turns, s: see [`Sensor::uneven_phase`].
    Uneven,
    /// An offset of all ranges that grows over the recording, m at its end: one of the courses of [`Moment::course`].
    Drift(usize),
    /// Pitch of the scene that grows with the square of the speed, rad at 10 m/s.
    Lean,
    /// Offset across one kind of surface, m: see [`kind_of`]. No cause: an error of the simulated surfaces.
    Structure(usize),
}

/// Number of columns, the first ones, that every frame has of its own: its pose, and its displacement over a scan.
pub const OWN: usize = 9;

/// All columns for a rig, those of the frames' own first; with those of time and ego motion where these are known.
pub fn columns(rig: &Rig, moments: &Moments) -> Vec<Column> {
    let mut all: Vec<Column> = (0..6).map(Column::Pose).collect();
    all.extend((0..3).map(Column::Sweep));
    all.extend([Column::Scan, Column::Uneven].into_iter().filter(|_| moments.drives));
    all.extend([Column::RangeOffset, Column::RangeScale]);
    all.extend((0..COURSES).filter(|_| moments.passes).map(Column::Drift));
    all.extend(Some(Column::Lean).filter(|_| moments.speed_varies));
    all.extend((0..KINDS).map(Column::Structure));
    if rig.sensors.len() > 1 {
        all.extend((0..rig.sensors.len()).flat_map(|s| (0..6).map(move |k| Column::SensorPose(s, k))));
    }
    all
}

/// Standard deviation of the offset of a kind of surface, m.
pub const STRUCTURE_M: f64 = 0.02;

/// Standard deviation of real surfaces from a plane, m.
const RIPPLE_M: f64 = 0.006;

/// Sums of one frame, in units of its noise.
#[derive(Clone, Debug)]
pub struct MeanFrame {
    /// X' W X.
    pub gram: DMatrix<f64>,
    /// X' W y.
    pub right: DVector<f64>,
}

/// Range noise of the simulated side, m: the median over its smooth returns.
pub fn usual_noise_m(frames: &[FramePair]) -> f64 {
    noise_m(frames.iter().flat_map(|f| &f.simulated))
}

/// Range noise of some returns of one side, m: the median over the smooth ones.
pub fn noise_m<'a>(rays: impl Iterator<Item = &'a Ray>) -> f64 {
    let values: Vec<f32> = rays
        .step_by(17)
        .filter(|r| r.smooth && r.cos_incidence > 0.2 && r.roughness_m.is_finite())
        .map(|r| r.roughness_m.abs() / (1.0 + r.roughness_leverage).sqrt())
        .collect();
    statistics::median_upper(values).map_or(0.01, |v| f64::from(v) / statistics::MEDIAN_OF_NORMAL).max(0.002)
}

/// Whether a measured ray is used for the place of a surface.
pub fn usable(ray: &Ray) -> bool {
    let stands = matches!(ray.surface, Surface::Ground | Surface::Standing) && !ray.at_object;
    ray.smooth && stands && ray.cos_incidence > 0.003
}

/// Common range bias of a frame, m: the median residual; 0 unless the median deviation from it is below half of it.
pub fn common_bias_m(frame: &FramePair) -> f64 {
    let squarely = |r: &&Ray| usable(r) && met_squarely(f64::from(r.residual_m), f64::from(r.cos_incidence));
    let off_m: Vec<f64> = frame.measured.iter().filter(squarely).map(|r| f64::from(r.residual_m)).collect();
    let bias_m = median(off_m.clone());
    let others_m = median(off_m.into_iter().map(|m| (m - bias_m).abs()).collect());
    if others_m < 0.5 * bias_m.abs() { bias_m } else { 0.0 }
}

/// Number of kinds of surfaces.
pub const KINDS: usize = 4;

/// The kind that is ground; all others stand.
pub const GROUND: usize = 0;

/// Kind of a ray's surface: ground; standing and facing right, facing left, or facing along the vehicle.
pub fn kind_of(ray: &Ray) -> usize {
    match ray.surface {
        Surface::Ground => GROUND,
        _ if ray.normal[1] < -0.3 => 1,
        _ if ray.normal[1] > 0.3 => 2,
        _ => 3,
    }
}

/// Inverse variance of its distance across the surface, 1/m2.
pub fn weight(ray: &Ray, noise_m: f64) -> f64 {
    let c = f64::from(ray.cos_incidence);
    1.0 / ((c * noise_m).powi(2) * 2.0 + RIPPLE_M * RIPPLE_M)
}

/// Derivatives of the distance across the surface by a movement of the scene about `center`.
pub fn pose_row(ray: &Ray, origin: &Point3<f64>, center: &Point3<f64>) -> SVector<f64, 6> {
    let n = ray.normal_vector();
    // The lever of the recorded place: at grazing incidence a turn moves the predicted one along the surface by metres.
    let lever = (origin + ray.recorded_vector() - center).cross(&n);
    SVector::from([lever.x, lever.y, lever.z, n.x, n.y, n.z])
}

/// Design effect: the variance of means over patches of directions, in units of that of independent residuals.
pub fn design_effect(frames: &[FramePair], mounts: &[Mount], poses: &[OwnPoses], noise_m: f64) -> f64 {
    let sums: Vec<[f64; 3]> = frames
        .par_iter()
        .zip(poses)
        .map(|(frame, pose)| {
            let mut patches = std::collections::BTreeMap::<(u8, i32, i32), [f64; 3]>::new();
            for ray in frame.measured.iter().filter(|r| usable(r)) {
                let w = weight(ray, noise_m);
                let Some(y) = off_surface_m(ray, &mounts[usize::from(ray.sensor)], pose) else { continue };
                let key =
                    (ray.sensor, (ray.azimuth_rad / 0.1).floor() as i32, (ray.elevation_rad / 0.05).floor() as i32);
                let patch = patches.entry(key).or_default();
                patch[0] += 1.0;
                patch[1] += w.sqrt() * y;
                patch[2] += w * y * y;
            }
            let big = patches.values().filter(|p| p[0] >= 10.0);
            big.fold([0.0; 3], |s, p| [s[0] + p[1] * p[1] / p[0], s[1] + p[2] / p[0], s[2] + 1.0])
        })
        .collect();
    let sum = sums.iter().fold([0.0; 3], |s, p| [s[0] + p[0], s[1] + p[1], s[2] + p[2]]);
    if sum[2] < 1.0 { 1.0 } else { (sum[0] / sum[2]).max(1.0) }
}

/// Derivatives of the distance of a ray's return across its surface by every column.
pub struct Levers {
    sensor: usize,
    kind: usize,
    range_m: f64,
    by_range: f64,
    phase: f64,
    by_motion: f64,
    courses: [f64; COURSES],
    lean: f64,
    pose: SVector<f64, 6>,
    sensor_pose: SVector<f64, 6>,
}

impl Levers {
    /// Of a measured ray of a sensor at `origin`, at the moment of its frame.
    pub fn new(ray: &Ray, origin: &Point3<f64>, mount: &Sensor, moment: &Moment) -> Self {
        let place = origin.coords + ray.recorded_vector();
        Levers {
            sensor: ray.sensor as usize,
            kind: kind_of(ray),
            range_m: ray.recorded_range_m(),
            by_range: ray.range_lever(),
            phase: mount.scan_phase(f64::from(ray.azimuth_rad), f64::from(ray.elevation_rad)),
            // The scene moves against the vehicle.
            by_motion: -ray.normal_vector().dot(&moment.own.velocity_at(&place)),
            courses: std::array::from_fn(|k| moment.course(k)),
            lean: moment.lean(),
            pose: pose_row(ray, origin, &Point3::origin()),
            sensor_pose: pose_row(ray, origin, origin),
        }
    }

    /// By one column; `None` of columns of other sensors and surfaces.
    pub fn of(&self, column: Column) -> Option<f64> {
        Some(match column {
            Column::RangeOffset => self.by_range,
            Column::RangeScale => self.by_range * self.range_m,
            Column::Pose(k) => self.pose[k],
            Column::SensorPose(s, k) if s == self.sensor => self.sensor_pose[k],
            Column::Sweep(k) => self.phase * [self.pose[3], self.pose[4], self.pose[2]][k],
            Column::Scan => self.phase * self.by_motion,
            Column::Uneven => Sensor::uneven_phase(self.phase) * self.by_motion,
            Column::Drift(k) => self.by_range * self.courses[k],
            Column::Lean => self.pose[1] * self.lean,
            Column::Structure(k) if k == self.kind => 1.0,
            Column::SensorPose(..) | Column::Structure(_) => return None,
        })
    }
}

/// What the rays of all frames are compared by.
pub struct Compared<'a> {
    /// Sensors.
    pub rig: &'a Rig,
    /// Columns of the fit.
    pub columns: &'a [Column],
    /// Range noise of the simulated side, m.
    pub noise_m: f64,
    /// See [`design_effect`].
    pub design: f64,
}

impl Compared<'_> {
    /// Calls `each` with every ray of a frame that is of its surface: with its non-zero columns, its distance across
    /// the surface, m, and its weight, 1/m2.
    pub fn for_each(
        &self,
        frame: &FramePair,
        pose: &OwnPoses,
        moment: &Moment,
        mut each: impl FnMut(&Ray, &[(usize, f64)], f64, f64),
    ) {
        let mounts = mounts(self.rig);
        // Most columns belong to other sensors and surfaces.
        let mut x: Vec<(usize, f64)> = Vec::with_capacity(self.columns.len());
        for ray in frame.measured.iter().filter(|r| usable(r)) {
            let sensor = ray.sensor as usize;
            if off_surface_m(ray, &mounts[sensor], pose).is_none() {
                continue;
            }
            let levers = Levers::new(ray, &mounts[sensor].origin, &self.rig.sensors[sensor], moment);
            x.clear();
            x.extend(self.columns.iter().enumerate().filter_map(|(k, column)| Some((k, levers.of(*column)?))));
            each(ray, &x, ray.across_nearest_m(), weight(ray, self.noise_m) / self.design);
        }
    }

    /// Sums of all frames, with the moment of each.
    pub fn sums(&self, frames: &[FramePair], poses: &[OwnPoses], moments: &[Moment]) -> Vec<MeanFrame> {
        let one = |((frame, pose), moment): ((&FramePair, &OwnPoses), &Moment)| {
            let p = self.columns.len();
            let (mut gram, mut right) = (vec![0.0; p * p], DVector::zeros(p));
            self.for_each(frame, pose, moment, |_, x, y, w| {
                for (i, &(k, v)) in x.iter().enumerate() {
                    let wx = w * v;
                    right[k] += wx * y;
                    let line = &mut gram[k * p..(k + 1) * p];
                    x[..=i].iter().for_each(|&(j, u)| line[j] += wx * u);
                }
            });
            let gram = DMatrix::from_fn(p, p, |i, j| gram[i.max(j) * p + i.min(j)]);
            MeanFrame { gram, right }
        };
        frames.par_iter().zip(poses).zip(moments).map(one).collect()
    }
}

/// Origins of the sensors in the cloud's frame.
pub fn origins(rig: &Rig) -> Vec<Point3<f64>> {
    rig.sensors.iter().map(|s| Point3::from(Vector3::from(s.position))).collect()
}

impl MeanFrame {
    /// No sums of some columns.
    pub fn zeros(columns: usize) -> MeanFrame {
        MeanFrame { gram: DMatrix::zeros(columns, columns), right: DVector::zeros(columns) }
    }

    /// Adds the sums of other rays.
    pub fn add(&mut self, other: &MeanFrame) {
        self.gram += &other.gram;
        self.right += &other.right;
    }

    /// The covariance of the frame's own pose and displacement over a scan, given all columns; `prior` holds the
    /// variances of their parameters.
    pub fn of_own(&self, prior: &SVector<f64, OWN>) -> Option<DMatrix<f64>> {
        let mut own = self.gram.view((0, 0), (OWN, OWN)).into_owned();
        for k in 0..OWN {
            own[(k, k)] += 1.0 / prior[k].max(1e-16);
        }
        own.try_inverse()
    }

    /// The frame's own pose and displacement over a scan that fit best where the products of the columns with the
    /// distances are these.
    pub fn own(&self, prior: &SVector<f64, OWN>, right: &DVector<f64>) -> DVector<f64> {
        self.of_own(prior).map_or_else(|| DVector::zeros(OWN), |inverse| inverse * right.rows(0, OWN))
    }

    /// The same sums with the frame's own pose and displacement over a scan integrated out.
    pub fn without_own(&self, prior: &SVector<f64, OWN>) -> (DMatrix<f64>, DVector<f64>) {
        let p = self.gram.nrows();
        let Some(inverse) = self.of_own(prior) else { return (self.gram.clone(), self.right.clone()) };
        let across = self.gram.view((0, 0), (p, OWN)).into_owned();
        let part = &across * inverse;
        let gram = &self.gram - &part * across.transpose();
        let right = &self.right - &part * self.right.rows(0, OWN);
        (gram, right)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::channels::motion::OwnMotion;

    /// A return of the road that is moved 1.5 m forward: range and pose change where it was recorded.
    #[test]
    fn levers_are_those_of_the_recorded_place() {
        let (recorded, moved) = (Vector3::new(3.0, 1.0, -2.0), Vector3::new(4.5, 1.0, -2.0));
        let ray = Ray {
            surface: Surface::Ground,
            normal: [0.0, 0.0, 1.0],
            cos_incidence: (2.0 / moved.norm()) as f32,
            recorded_m: recorded.cast::<f32>().into(),
            ..Ray::standing(&moved)
        };
        let levers = Levers::new(&ray, &Point3::origin(), &Rig::single().sensors[0], &Moment::default());
        let height_m = |recorded: Vector3<f64>| recorded.z + 2.0;
        let pitched = nalgebra::Rotation3::from_axis_angle(&Vector3::y_axis(), 1e-3) * recorded;
        let changed = [
            (Column::RangeOffset, height_m(recorded + recorded.normalize() * 1e-3)),
            (Column::RangeScale, height_m(recorded * (1.0 + 1e-3))),
            (Column::Pose(1), height_m(pitched)),
            (Column::Pose(5), 1e-3),
        ];
        for (column, by_m) in changed {
            let lever = levers.of(column).unwrap();
            assert!((1e-3 * lever - by_m).abs() < 1e-5, "{column:?}: {lever} {by_m}");
        }
    }

    /// A vehicle that drives and turns during a scan sees a wall that stands still move.
    #[test]
    fn levers_of_a_scan_are_those_of_the_motion() {
        let place = Vector3::new(-9.0, 4.0, 0.5);
        let normal = Vector3::new(0.8, -0.6, 0.0);
        let ray = Ray { normal: normal.cast::<f32>().into(), ..Ray::standing(&place) };
        let own = OwnMotion { velocity_m_s: Vector3::new(8.0, 0.5, 0.0), turn_rate_rad_s: Vector3::new(0.0, 0.0, 0.3) };
        let rig = Rig::single();
        let moment = Moment { own, ..Moment::default() };
        let levers = Levers::new(&ray, &Point3::origin(), &rig.sensors[0], &moment);
        let phase = rig.sensors[0].scan_phase(f64::from(ray.azimuth_rad), f64::from(ray.elevation_rad));
        let by_motion = -normal.dot(&own.velocity_at(&place));
        for (column, share) in [(Column::Scan, phase), (Column::Uneven, (std::f64::consts::TAU * phase).sin())] {
            let lever = levers.of(column).unwrap();
            assert!((lever - share * by_motion).abs() < 1e-5, "{column:?}: {lever} {}", share * by_motion);
        }
    }

    /// Half-way through a recording, at 20 m/s.
    #[test]
    fn levers_of_drift_and_lean_are_those_of_the_moment() {
        let ray = Ray { normal: [0.0, 0.0, 1.0], ..Ray::standing(&Vector3::new(9.0, 4.0, -2.0)) };
        let moment = Moment { time_s: 10.0, passed: 0.5, own: OwnMotion::ahead(20.0) };
        let levers = Levers::new(&ray, &Point3::origin(), &Rig::single().sensors[0], &moment);
        let of = |column| levers.of(column).unwrap();
        assert!((of(Column::Lean) - 4.0 * of(Column::Pose(1))).abs() < 1e-9);
        let share = (1.0 - (-1.0f64).exp()) / (1.0 - (-2.0f64).exp());
        assert!((of(Column::Drift(1)) - share * of(Column::RangeOffset)).abs() < 1e-9);
    }
}
