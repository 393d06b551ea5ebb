//! The pose error that each frame has of its own, with its displacement over a scan: robust fits, sensor by sensor,
//! that are taken out before returns are compared.

use super::mean::{origins, pose_row, usable, weight};
use crate::pairing::{FramePair, Ray};
use nalgebra::{Point3, SMatrix, SVector};
use sensor::{Rig, Sensor};

/// Distance from the surface, after the frame's own pose is subtracted, from which on a return is not of it, m.
const STRAY_M: f64 = 0.30;

/// Numbers of an [`OwnPoses`] for each sensor.
pub const OWN_NUMBERS: usize = 10;

/// The first of them but the displacement over a scan.
pub const OWN_AT_ONCE: usize = 7;

/// Pose error of one frame as each sensor by itself sees it: turns about the cloud's origin, rad, and shifts, m; then
/// the offset of all ranges, m, without which a range bias is taken for a pose, another one in each scene; then the
/// displacement over a scan, along x and y, m, and about z, rad, where a sensor scans row after row: walls that lean by
/// it are taken for a pitch otherwise.
pub type OwnPoses = Vec<SVector<f64, OWN_NUMBERS>>;

/// Standard deviations of ego motion: speed along and across the heading, m/s; yaw rate, rad/s.
const OWN_MOTION: [f64; 3] = [40.0, 3.0, 0.3];

/// Where a sensor stands, and how it scans.
pub struct Mount<'a> {
    /// Its origin in the cloud's frame.
    pub origin: Point3<f64>,
    /// The sensor, where it scans row after row.
    by_rows: Option<&'a Sensor>,
}

/// Those of all sensors.
pub fn mounts(rig: &Rig) -> Vec<Mount<'_>> {
    let by_rows = |sensor| Some(sensor).filter(|s: &&Sensor| !s.sequential_rows().is_empty());
    rig.sensors.iter().zip(origins(rig)).map(|(sensor, origin)| Mount { origin, by_rows: by_rows(sensor) }).collect()
}

/// Standard deviations of the displacement over a scan of a driving vehicle, along x and y, m, and about z, rad: zero
/// unless the sensor scans row after row. Static surfaces are then displaced along columns, which resembles an error of
/// its pose.
pub fn own_slide(sensor: &Sensor) -> [f64; 3] {
    let by_rows = !sensor.sequential_rows().is_empty();
    OWN_MOTION.map(|motion| if by_rows { motion / sensor.rate_hz } else { 0.0 })
}

/// Derivatives of the distance across the surface by what [`OwnPoses`] holds of a sensor.
pub fn own_row(ray: &Ray, mount: &Mount) -> SVector<f64, OWN_NUMBERS> {
    let [a, b, c, d, e, f]: [f64; 6] = pose_row(ray, &mount.origin, &Point3::origin()).into();
    let phase = |sensor: &Sensor| sensor.scan_phase(f64::from(ray.azimuth_rad), f64::from(ray.elevation_rad));
    let phase = mount.by_rows.map_or(0.0, phase);
    SVector::from([a, b, c, d, e, f, ray.range_lever(), phase * d, phase * e, phase * c])
}

/// Distance of a ray's return across its surface, with its frame's own pose taken out, m; `None` where it is not of the
/// surface. `mount` is that of its sensor.
pub fn off_surface_m(ray: &Ray, mount: &Mount, pose: &OwnPoses) -> Option<f64> {
    let y = ray.across_nearest_m() - own_row(ray, mount).dot(&pose[usize::from(ray.sensor)]);
    (y.abs() <= STRAY_M).then_some(y)
}

/// Prior standard deviations of a frame's own pose when it is fitted alone: 2 degrees, 0.5 m; and of its range offset.
pub const LOOSE: [f64; OWN_AT_ONCE] = [0.035, 0.035, 0.035, 0.5, 0.5, 0.5, 0.5];

/// The pose error of one frame as each sensor sees it, fitted with redescending weights.
pub fn own_poses(frame: &FramePair, mounts: &[Mount], noise_m: f64) -> OwnPoses {
    own_poses_within(frame, mounts, noise_m, &LOOSE)
}

/// The same with other prior standard deviations of the numbers but the displacement over a scan.
pub fn own_poses_within(frame: &FramePair, mounts: &[Mount], noise_m: f64, within: &[f64; OWN_AT_ONCE]) -> OwnPoses {
    let of_sensor = |(sensor, mount): (usize, &Mount)| {
        let Some(by_rows) = mount.by_rows else {
            let pose = own_pose::<OWN_AT_ONCE>(frame, (sensor, mount), within, noise_m);
            return SVector::from_fn(|k, _| if k < OWN_AT_ONCE { pose[k] } else { 0.0 });
        };
        let slide = own_slide(by_rows);
        let prior = std::array::from_fn(|k| if k < OWN_AT_ONCE { within[k] } else { slide[k - OWN_AT_ONCE] });
        own_pose::<OWN_NUMBERS>(frame, (sensor, mount), &prior, noise_m)
    };
    mounts.iter().enumerate().map(of_sensor).collect()
}

/// The first `N` of its numbers, for their prior standard deviations.
fn own_pose<const N: usize>(
    frame: &FramePair,
    (sensor, mount): (usize, &Mount),
    prior: &[f64; N],
    noise_m: f64,
) -> SVector<f64, N> {
    let rows: Vec<(SVector<f64, N>, f64, f64)> = frame
        .measured
        .iter()
        .filter(|r| usable(r) && r.sensor as usize == sensor)
        .map(|r| (own_row(r, mount).fixed_rows::<N>(0).into(), r.across_nearest_m(), weight(r, noise_m)))
        .collect();
    let prior = SVector::from(*prior).map(|s| 1.0 / (s * s));
    let mut pose = SVector::<f64, N>::zeros();
    for scale in [0.5, 0.3, 0.15, 0.1, 0.07, 0.07] {
        let mut system = SMatrix::<f64, N, N>::from_diagonal(&prior);
        let mut right = SVector::<f64, N>::zeros();
        for (row, y, w) in &rows {
            let u = (y - row.dot(&pose)) / (4.0 * scale);
            if u.abs() < 1.0 {
                // Errors of neighbours are correlated: a fiftieth of the weight keeps the prior meaningful.
                let w = w * (1.0 - u * u).powi(2) / 50.0;
                system += row * row.transpose() * w;
                right += row * (w * y);
            }
        }
        match system.try_inverse() {
            Some(inverse) => pose = inverse * right,
            None => return SVector::zeros(),
        }
    }
    pose
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pairing::Surface;
    use nalgebra::Vector3;
    use std::f64::consts::TAU;

    /// A frame of returns whose ranges are longer by an offset: a road 2 m below the sensor, and a wall to its left.
    fn frame(offset_m: f64, wall_m: f64) -> FramePair {
        let return_ = |direction: Vector3<f64>| {
            let (range_m, normal, surface) = if direction.z < -0.05 {
                (-2.0 / direction.z, Vector3::z(), Surface::Ground)
            } else {
                (wall_m / direction.y, -Vector3::y(), Surface::Standing)
            };
            let cos_incidence = -normal.dot(&direction);
            let met = cos_incidence > 0.05 && range_m > 0.0;
            met.then(|| Ray {
                surface,
                normal: normal.cast::<f32>().into(),
                cos_incidence: cos_incidence as f32,
                residual_m: offset_m as f32,
                ..Ray::standing(&(direction * range_m))
            })
        };
        let shot = |k: u32| {
            let (azimuth, elevation) = (TAU * f64::from(k % 180) / 180.0, 0.02 * f64::from(k / 180) - 0.3);
            Vector3::new(elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin())
        };
        let measured = (0..180 * 20).filter_map(|k| return_(shot(k))).collect();
        FramePair::of_rays(String::new(), measured, vec![])
    }

    /// A wall across the road, met while the vehicle drives: its rows are scanned one after the other.
    #[test]
    fn a_wall_that_leans_by_the_motion_over_a_scan_is_no_pose() {
        let rows = "pattern = { blocks = [{ rows = 20, top_deg = 5, bottom_deg = -17 }], columns = 180 }\n";
        let sensor: Sensor = toml::from_str(&format!("name = \"a\"\nrate_hz = 20\n{rows}")).unwrap();
        let mut frame = frame(0.0, 12.0);
        for ray in &mut frame.measured {
            // The wall stands at an angle to the course.
            let along = if ray.surface == Surface::Ground { 0.0 } else { 0.5 };
            let phase = sensor.scan_phase(f64::from(ray.azimuth_rad), f64::from(ray.elevation_rad));
            ray.normal = if along == 0.0 { ray.normal } else { [-0.5, -0.75f32.sqrt(), 0.0] };
            ray.residual_m = (along * 2.0 * phase / f64::from(ray.cos_incidence)) as f32;
        }
        let pose = |rig: &Rig| own_poses(&frame, &mounts(rig), 0.01)[0];
        let [with, without] = [pose(&Rig { sensors: vec![sensor] }), pose(&Rig::single())];
        assert!(with.fixed_rows::<OWN_AT_ONCE>(0).norm() < 2e-3 && (with[7] - 2.0).abs() < 0.05, "{with}");
        assert!(without.fixed_rows::<6>(0).norm() > 0.1 && without[7] == 0.0, "{without}");
    }

    #[test]
    fn a_range_bias_is_no_pose_of_frames() {
        for wall_m in [4.0, 9.0] {
            let own = own_poses(&frame(-0.2, wall_m), &mounts(&Rig::single()), 0.01)[0];
            assert!(own.fixed_rows::<6>(0).norm() < 2e-3 && (own[6] + 0.2).abs() < 2e-3, "{wall_m}: {own}");
        }
    }
}
