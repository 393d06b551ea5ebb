//! Conventions of poses on a real drive and on made scenes.

use super::*;
use nalgebra::Point3;
use std::path::Path;

/// Posts and corners around a bend, seen from the pose.
fn scene(pose: &Pose) -> Vec<[f32; 3]> {
    let mut points = Vec::new();
    for i in 0..60 {
        let (x, y) = (f64::from(i * 17 % 61) - 20.0, f64::from(i * 29 % 53) - 20.0);
        for k in 0..60 {
            let (a, z) = (f64::from(k % 12) * 0.15, f64::from(k / 12) * 0.5);
            points.push(Point3::new(x + a, y, z));
            points.push(Point3::new(x, y + 0.7 * a, z));
        }
    }
    let seen = points.iter().map(|p| (pose.inverse() * p).coords).filter(|p| p.norm() < 40.0);
    seen.map(|p| [p.x as f32, p.y as f32, p.z as f32]).collect()
}

/// A path through a bend to the left that climbs a little.
fn path() -> Vec<Pose> {
    let pose = |i: usize| {
        let s = 1.5 * i as f64;
        let yaw = 0.05 * s;
        let place = Vector3::new(20.0 * yaw.sin(), 20.0 * (1.0 - yaw.cos()), 1.7 + 0.02 * s);
        Pose::from_parts(place.into(), UnitQuaternion::from_euler_angles(0.0, -0.02, yaw))
    };
    (0..16).map(pose).collect()
}

/// Poses that the convention turns into the true ones.
fn in_convention(convention: Convention, truth: &[Pose]) -> Vec<Pose> {
    let turned = |lidar_from_axes: &Axes| {
        let turn = rotation(lidar_from_axes);
        truth.iter().map(|pose| turn.inverse() * pose * turn).collect::<Vec<Pose>>()
    };
    let inverse = |poses: Vec<Pose>| poses.iter().map(Pose::inverse).collect::<Vec<_>>();
    match convention {
        Convention::AsGiven => truth.to_vec(),
        Convention::Inverse => inverse(truth.to_vec()),
        Convention::Camera => turned(&LIDAR_FROM_CAMERA),
        Convention::InverseCamera => inverse(turned(&LIDAR_FROM_CAMERA)),
        Convention::RightForward => turned(&LIDAR_FROM_RIGHT_FORWARD),
        Convention::InverseRightForward => inverse(turned(&LIDAR_FROM_RIGHT_FORWARD)),
        Convention::Mirrored => truth.iter().map(mirrored).collect(),
        Convention::InverseMirrored => inverse(truth.iter().map(mirrored).collect()),
        Convention::RadiansAsDegrees => {
            let narrow = |pose: &Pose| {
                let rotation = UnitQuaternion::from_scaled_axis(pose.rotation.scaled_axis().map(f64::to_radians));
                Pose::from_parts(pose.translation, rotation)
            };
            truth.iter().map(narrow).collect()
        }
    }
}

#[test]
fn each_convention_is_found_and_undone() {
    let truth = path();
    let scans: Vec<Vec<[f32; 3]>> = truth.iter().map(scene).collect();
    for convention in Convention::ALL {
        let given = in_convention(convention, &truth);
        let report = find_convention(&scans, &given);
        let want = if convention == Convention::AsGiven { Verdict::AsGiven } else { Verdict::Other(convention) };
        assert_eq!(report.verdict, want, "{report}\n{:?}", report.candidates);
        let [first, second] = [0, 1].map(|i| report.candidates[i].spread);
        assert!(first < 0.9 * second, "{convention}: {:?}", report.candidates);
        for (found, truth) in convention.world_from_lidar(&given).iter().zip(&truth) {
            let off = (found.translation.vector - truth.translation.vector).norm();
            assert!(off < 1e-9 && found.rotation.angle_to(&truth.rotation) < 1e-6, "{convention}: {found} {truth}");
        }
    }
}

#[test]
fn a_camera_in_an_upright_world_keeps_its_world() {
    let truth = path();
    let turn = rotation(&LIDAR_FROM_CAMERA);
    let given: Vec<Pose> = truth.iter().map(|pose| pose * turn).collect();
    for (found, truth) in Convention::Camera.world_from_lidar(&given).iter().zip(&truth) {
        assert!(found.rotation.angle_to(&truth.rotation) < 1e-6);
    }
}

#[test]
fn useless_poses_and_standing_vehicles_are_named() {
    let truth = path();
    let scans: Vec<Vec<[f32; 3]>> = truth.iter().map(scene).collect();
    let still = vec![truth[3]; truth.len()];
    let report = find_convention(&scans, &still);
    assert_eq!(report.verdict, Verdict::Unknown, "{report}");
    assert_eq!(find_convention(&scans[..1], &truth[..1]).verdict, Verdict::Unknown);
    assert_eq!(find_convention::<Vec<[f32; 3]>>(&[], &[]).verdict, Verdict::Unknown);
    // One place seen again and again, with poses that claim a drive.
    let same = vec![scene(&truth[3]); truth.len()];
    let report = find_convention(&same, &truth);
    assert_eq!(report.verdict, Verdict::None, "{report}");
    assert!(report.to_string().contains("by the odometry"));
}

#[test]
fn the_convention_of_a_real_drive_is_found() {
    let root = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data/kitti_raw_0001"));
    if !root.exists() {
        return eprintln!("skipped: {} is not there", root.display());
    }
    let dataset = data::Dataset::open(root).unwrap();
    let ids = dataset.all_ids().unwrap();
    let scan = |id: &String| {
        let cloud = dataset.load_cloud(id).unwrap();
        (0..cloud.len()).map(|i| cloud.xyz(i)).collect::<Vec<[f32; 3]>>()
    };
    let scans: Vec<Vec<[f32; 3]>> = ids.iter().map(scan).collect();
    let truth: Vec<Pose> = dataset.moments(&ids).unwrap().iter().map(|m| m.world_from_lidar.unwrap()).collect();
    for convention in Convention::ALL {
        let report = find_convention(&scans, &in_convention(convention, &truth));
        let want = if convention == Convention::AsGiven { Verdict::AsGiven } else { Verdict::Other(convention) };
        assert_eq!(report.verdict, want, "{report}\n{:?}", report.candidates);
    }
}
