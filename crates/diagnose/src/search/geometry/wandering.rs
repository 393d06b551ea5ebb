//! Frames that lie elsewhere than the others, each by a pose error of its own.

use crate::catalogue::sizes::{SHIFT_M, TURN_RAD};
use crate::channels::mean::OWN;
use crate::channels::own_poses::{LOOSE, OWN_AT_ONCE, mounts, own_poses_within};
use crate::pairing::FramePair;
use nalgebra::SVector;
use rayon::prelude::*;
use sensor::Rig;

/// Turn and shift of each frame, as each sensor sees them, about the origin of the cloud, rad and m: the most probable
/// ones where the scatter of all frames is the prior. Empty where frames scatter by less than is reported of a scene.
/// `own_prior` are the variances of what a frame has of its own, `noise_m` is the range noise of the simulated side.
pub(super) fn wandering(
    frames: &[FramePair],
    rig: &Rig,
    own_prior: &SVector<f64, OWN>,
    noise_m: f64,
) -> Vec<Vec<SVector<f64, 6>>> {
    let scatter: [f64; 6] = std::array::from_fn(|k| own_prior[k].sqrt());
    if scatter.iter().enumerate().all(|(k, scatter)| *scatter < if k < 3 { TURN_RAD } else { SHIFT_M }) {
        return vec![];
    }
    let within: [f64; OWN_AT_ONCE] = std::array::from_fn(|k| scatter.get(k).copied().unwrap_or(LOOSE[k]));
    let mounts = mounts(rig);
    let poses = frames.par_iter().map(|frame| own_poses_within(frame, &mounts, noise_m, &within));
    poses.map(|sensors| sensors.iter().map(|pose| pose.fixed_rows::<6>(0).into()).collect()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::channels::own_poses::{OWN_NUMBERS, own_row};
    use crate::pairing::{Ray, Surface};
    use nalgebra::Vector3;

    /// A road 2 m below the sensor and walls on two sides, displaced by a pose.
    fn frame(rig: &Rig, pose: &SVector<f64, OWN_NUMBERS>) -> FramePair {
        let planes = [
            (-Vector3::x(), 15.0, Surface::Standing),
            (-Vector3::y(), 8.0, Surface::Standing),
            (Vector3::z(), 2.0, Surface::Ground),
        ];
        let shot = |k: u32| {
            let (azimuth, elevation) = (f64::from(k % 120) * 0.0131, 0.02 * f64::from(k / 120) - 0.3);
            let direction =
                Vector3::new(elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin());
            let met = planes.map(|(normal, at_m, surface)| (-at_m / normal.dot(&direction), normal, surface));
            let ahead = met.into_iter().filter(|(range_m, ..)| *range_m > 0.0);
            let (range_m, normal, surface) = ahead.min_by(|a, b| a.0.total_cmp(&b.0)).unwrap();
            let cos_incidence = -normal.dot(&direction);
            let ray = Ray {
                surface,
                normal: normal.cast::<f32>().into(),
                cos_incidence: cos_incidence as f32,
                ..Ray::standing(&(direction * range_m))
            };
            let across_m = own_row(&ray, &mounts(rig)[0]).dot(pose);
            let residual_m = (-across_m / cos_incidence) as f32;
            Ray { residual_m, ..ray }
        };
        FramePair::of_rays(String::new(), (0..120 * 24).map(shot).collect(), vec![])
    }

    #[test]
    fn frames_are_found_where_they_are() {
        let rig = Rig::single();
        let pose = |k: usize| {
            let by = [0.2, -0.1, 0.15, -0.25][k];
            SVector::from([0.01 * by, -0.01 * by, 0.02 * by, by, -by, 0.2 * by, 0.0, 0.0, 0.0, 0.0])
        };
        let frames: Vec<FramePair> = (0..4).map(|k| frame(&rig, &pose(k))).collect();
        let prior = |turn: f64, shift: f64| SVector::from_fn(|k, _| if k < 3 { turn * turn } else { shift * shift });
        let found = wandering(&frames, &rig, &prior(0.003, 0.2), 0.01);
        for (k, sensors) in found.iter().enumerate() {
            let off = sensors[0] - pose(k).fixed_rows::<6>(0);
            assert!(off.fixed_rows::<3>(0).norm() < 1e-3 && off.fixed_rows::<3>(3).norm() < 0.02, "{k} {off}");
        }
        assert_eq!(found.len(), 4);
        assert!(wandering(&frames, &rig, &prior(3e-4, 0.02), 0.01).is_empty(), "less than is reported");
    }
}
