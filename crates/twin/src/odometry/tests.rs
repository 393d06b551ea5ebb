//! The odometry on a made street and on a real drive.

use super::*;
use nalgebra::Vector3;
use std::path::Path;

/// A rectangle: corner and both sides, m, world.
type Face = [[f64; 3]; 3];

/// The ground, two walls with houses before them, and cars: what a street shows.
fn street() -> Vec<Face> {
    let mut faces = vec![
        [[-40.0, -11.0, 0.0], [120.0, 0.0, 0.0], [0.0, 21.0, 0.0]],
        [[-40.0, 10.0, 0.0], [120.0, 0.0, 0.0], [0.0, 0.0, 6.0]],
        [[-40.0, -11.0, 0.0], [120.0, 2.0, 0.0], [0.0, 0.0, 5.0]],
    ];
    let mut block = |x: f64, y: f64, size: [f64; 3]| {
        let [l, w, h] = size;
        faces.push([[x, y, 0.0], [l, 0.0, 0.0], [0.0, 0.0, h]]);
        faces.push([[x, y + w, 0.0], [l, 0.0, 0.0], [0.0, 0.0, h]]);
        faces.push([[x, y, 0.0], [0.0, w, 0.0], [0.0, 0.0, h]]);
        faces.push([[x + l, y, 0.0], [0.0, w, 0.0], [0.0, 0.0, h]]);
    };
    for k in 0..17 {
        let x = 7.0 * f64::from(k) - 39.0;
        block(x, 6.3, [2.8, 3.7, 5.0]);
        block(x + 3.1, -11.0, [3.1, 4.2, 4.0]);
        block(x + 1.0, if k % 2 == 0 { 3.5 } else { -5.0 }, [4.2, 1.8, 1.5]);
    }
    faces
}

/// Position on the path at a time in turns of the sensor: a start from rest, then a bend.
fn pose(turns: f64) -> Pose {
    let along = 0.06 * turns * turns;
    let yaw = 0.01 * turns;
    Pose::new(Vector3::new(along, 0.3 * along * yaw, 1.7), Vector3::new(0.0, 0.0, yaw))
}

/// A scan within 30 m and its times, s. The points of each face are drawn anew for each scan. With `rolling`, each
/// point is seen at the pose of its time.
fn scan(faces: &[Face], number: usize, rolling: bool) -> (Vec<[f32; 3]>, Vec<f32>) {
    let mut scan = (Vec::new(), Vec::new());
    for (f, [corner, u, v]) in faces.iter().enumerate() {
        let (corner, u, v) = (Vector3::from(*corner), Vector3::from(*u), Vector3::from(*v));
        for i in 0..(6.0 * u.cross(&v).norm()) as usize {
            let share = |what: u64| share([number as u64, f as u64, i as u64, what]);
            let p = corner + u * share(0) + v * share(1);
            let turn = if rolling { share(2) - 0.5 } else { 0.0 };
            let seen = pose(number as f64 + turn).inverse() * Point3::from(p);
            if seen.coords.norm() < 30.0 {
                scan.0.push([seen.x as f32, seen.y as f32, seen.z as f32]);
                scan.1.push(0.1 * turn as f32);
            }
        }
    }
    scan
}

/// A number in [0, 1) that looks like chance (SplitMix64). Points of a grid would fit to each other.
fn share(of: [u64; 4]) -> f64 {
    let mix = |hash: u64, value: u64| {
        let z = (hash ^ value).wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    };
    (of.into_iter().fold(0, mix) >> 11) as f64 / (1u64 << 53) as f64
}

fn error_m(found: &Pose, truth: &Pose) -> f64 {
    (found.translation.vector - truth.translation.vector).norm()
}

/// The path of 15 scans.
fn drive(rolling: bool, with_times: bool) -> Vec<Pose> {
    let world = street();
    let mut odometry = Odometry::new(OdometryConfig::default());
    (0..15)
        .map(|i| {
            let (points, times) = scan(&world, i, rolling);
            odometry.add(&points, with_times.then_some(&times))
        })
        .collect()
}

#[test]
fn a_drive_through_a_street_is_found() {
    let path = drive(false, false);
    for (i, found) in path.iter().enumerate() {
        let truth = pose(0.0).inverse() * pose(i as f64);
        let (off_m, off_rad) = (error_m(found, &truth), found.rotation.angle_to(&truth.rotation));
        assert!(off_m < 0.15 && off_rad < 0.004, "scan {i}: {off_m} m, {off_rad} rad");
    }
}

#[test]
fn times_free_scans_of_their_motion() {
    let end = pose(0.0).inverse() * pose(14.0);
    let (with, without) = (drive(true, true), drive(true, false));
    let (with, without) = (error_m(&with[14], &end), error_m(&without[14], &end));
    assert!(with < 0.15 && with < 0.8 * without, "{with} m with times, {without} m without");
}

#[test]
fn the_same_bits_for_any_number_of_threads() {
    let on = |threads| rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    let one = on(1).install(|| drive(false, false));
    assert_eq!(on(3).install(|| drive(false, false)), one);
    let world = street();
    let scans: Vec<Vec<[f32; 3]>> = (0..6).map(|i| scan(&world, i, false).0).collect();
    let refined = |threads| on(threads).install(|| refine(&scans, &one[..6], &RefineConfig::default()));
    assert_eq!(refined(3), refined(1));
}

#[test]
fn what_is_not_finite_is_left_out_and_empty_clouds_keep_the_motion() {
    let world = street();
    let mut odometry = Odometry::new(OdometryConfig::default());
    for i in 0..4 {
        let mut points = scan(&world, i, false).0;
        points.push([f32::NAN, 0.0, 0.0]);
        points.push([f32::INFINITY, 0.0, 0.0]);
        odometry.add(&points, None);
    }
    let predicted = odometry.add(&[], None);
    let truth = pose(0.0).inverse() * pose(4.0);
    assert!(error_m(&predicted, &truth) < 0.2, "{predicted}");
}

#[test]
fn disturbed_poses_are_refined() {
    let world = street();
    let truth: Vec<Pose> = (0..10).map(|i| pose(i as f64)).collect();
    let scans: Vec<Vec<[f32; 3]>> = (0..10).map(|i| scan(&world, i, false).0).collect();
    let disturbed = |(i, pose): (usize, &Pose)| {
        let wave = |k: f64| if i == 0 { 0.0 } else { (i as f64 * k).sin() };
        pose * Pose::new(
            0.15 * Vector3::new(wave(2.1), wave(3.7), wave(1.3)),
            Vector3::new(0.0, 0.0, 0.006 * wave(5.0)),
        )
    };
    let given: Vec<Pose> = truth.iter().enumerate().map(disturbed).collect();
    let refined = refine(&scans, &given, &RefineConfig::default());
    // The first pose is kept: a small turn of it turns all others about it.
    let step_error = |poses: &[Pose], i: usize| {
        let step = |poses: &[Pose]| poses[i - 1].inverse() * poses[i];
        error_m(&step(poses), &step(&truth))
    };
    let worst = |poses: &[Pose]| (1..10).map(|i| step_error(poses, i)).fold(0.0, f64::max);
    assert!(worst(&given) > 0.2 && worst(&refined.poses) < 0.01, "{} {} m", worst(&given), worst(&refined.poses));
    assert!((0.1..0.5).contains(&refined.farthest_m), "{}", refined.farthest_m);
    let (before, after) = (refined.before.unwrap(), refined.after.unwrap());
    assert!(after.wall_thickness_m < 0.5 * before.wall_thickness_m, "{before:?} {after:?}");
}

/// Positions, m, that PyPI's kiss-icp 1.3.0 gives the frames 10, 20 and 35 of the drive: its defaults, a voxel of 1 m,
/// no deskewing.
const KISS_ICP_M: [(usize, [f64; 3]); 3] =
    [(10, [12.0247, -0.0813, 0.1563]), (20, [24.4563, -0.6146, 0.2955]), (35, [42.2244, -2.0293, 0.4199])];

#[test]
fn a_real_drive_goes_where_kiss_icp_goes() {
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
    let mut odometry = Odometry::new(OdometryConfig::default());
    let path: Vec<Pose> = scans.iter().map(|points| odometry.add(points, None)).collect();
    let length: f64 = path.windows(2).map(|pair| error_m(&pair[0], &pair[1])).sum();
    assert!((40.0..45.0).contains(&length), "{length} m");
    for (frame, want) in KISS_ICP_M {
        let off = (path[frame].translation.vector - Vector3::from(want)).norm();
        assert!(off < 0.01 * length, "frame {frame}: {off} m of {length} m");
    }

    // From the poses of the GPS and from those of the odometry, the refinement finds one path.
    let given: Vec<Pose> = dataset.moments(&ids).unwrap().iter().map(|m| m.world_from_lidar.unwrap()).collect();
    let [gps, own] = [&given, &path].map(|poses| refine(&scans, poses, &RefineConfig::default()));
    let end = |refined: &Refined| refined.poses[0].inverse() * refined.poses[35];
    assert!(error_m(&end(&gps), &end(&own)) < 0.03, "{} {}", end(&gps), end(&own));
    let (before, after) = (gps.before.unwrap(), gps.after.unwrap());
    assert!(after.walls as f64 > 1.3 * before.walls as f64, "{before:?} {after:?}");
    assert!(after.planar_share > before.planar_share + 0.05 && after.wall_thickness_m < before.wall_thickness_m);
}
