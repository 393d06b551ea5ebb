//! Twins of a made-up recording with exact ranges, and of real scans.

use data::Dataset;
use lidarshift_twin::map::FusionConfig;
use lidarshift_twin::{Leave, PoseOptions, PoseSource, Recording, TwinConfig, TwinReport, pair};
use nalgebra::Vector3;
use std::fmt::Write;
use std::path::Path;

/// Range from a place in a room of 30 x 20 x 5 m, with its floor at z = 0, along a direction.
fn room(from: Vector3<f64>, direction: Vector3<f64>) -> f64 {
    let (low, high) = (Vector3::new(-10.0, -8.0, 0.0), Vector3::new(20.0, 12.0, 5.0));
    let wall = |k: usize| ((if direction[k] > 0.0 { high[k] } else { low[k] }) - from[k]) / direction[k];
    (0..3).map(wall).fold(f64::INFINITY, f64::min)
}

/// Writes a recording of the room by 24 rows of 400 shots, from a sensor that drives 1 m a frame. Shots through the
/// window (a part of one wall) have no return. A box of 4 x 2 x 1.5 m stands in the room.
fn write_recording(root: &Path, frames: usize) {
    std::fs::create_dir_all(root.join("velodyne")).unwrap();
    let (mut poses, mut labels) = (String::new(), String::from("frame,track,class,cx,cy,cz,l,w,h,yaw\n"));
    for frame in 0..frames {
        let at = Vector3::new(frame as f64, 0.0, 1.7);
        let mut bytes = Vec::new();
        for row in 0..24 {
            for column in 0..400 {
                let (azimuth, elevation) =
                    ((f64::from(column) + 0.5) * 0.9_f64.to_radians(), (8.3 - f64::from(row)).to_radians());
                let direction = Vector3::from(sensor::rig::direction(azimuth, elevation));
                let mut range = room(at, direction);
                let hit = at + direction * range;
                if hit.x > 19.99 && (2.0..6.0).contains(&hit.y) {
                    continue;
                }
                let low = Vector3::new(8.0, 3.0, 0.0);
                let (mut near, mut far) = (0.0f64, f64::INFINITY);
                for (k, size) in [4.0, 2.0, 1.5].into_iter().enumerate() {
                    let [a, b] = [low[k], low[k] + size].map(|face| (face - at[k]) / direction[k]);
                    (near, far) = (near.max(a.min(b)), far.min(a.max(b)));
                }
                if near < far {
                    range = range.min(near);
                }
                let p = direction * range;
                for v in [p.x, p.y, p.z, 0.5] {
                    bytes.extend((v as f32).to_le_bytes());
                }
            }
        }
        std::fs::write(root.join(format!("velodyne/{frame:06}.bin")), bytes).unwrap();
        writeln!(poses, "1 0 0 {} 0 1 0 {} 0 0 1 {}", at.x, at.y, at.z).unwrap();
        writeln!(labels, "{frame},7,Car,{},4.0,{},4.0,2.0,1.5,0.0", 10.0 - at.x, 0.75 - at.z).unwrap();
    }
    std::fs::write(root.join("poses.txt"), poses).unwrap();
    std::fs::write(root.join("labels.csv"), labels).unwrap();
}

const KEEP: PoseOptions = PoseOptions { odometry: false, refine: false };

fn twin_of(root: &Path, out: &Path, frames: Option<usize>, options: PoseOptions) -> TwinReport {
    let recording = Recording::open(Dataset::open(root).unwrap(), frames, options).unwrap();
    let config = TwinConfig { leave: Leave::Alternate, fusion: FusionConfig::default(), write_maps: true };
    pair::make(&recording, &config, out, &|_, _| ()).unwrap()
}

#[test]
fn a_room_is_shown_as_it_is_and_a_lost_shot_has_no_surface_where_nobody_saw_one() {
    let folder = tempfile::tempdir().unwrap();
    let (root, out) = (folder.path().join("room"), folder.path().join("twin"));
    write_recording(&root, 10);
    let report = twin_of(&root, &out, None, KEEP);
    assert_eq!((report.frames, report.poses), (10, PoseSource::Recording));
    let world = report.static_world;
    assert!(world.median_abs_m.unwrap() < 0.02 && world.within_10_cm.unwrap() > 0.9, "{world:?}");
    assert!(world.met_share > 0.97 && world.twin_met_share > 0.99, "{world:?}");
    assert!(report.objects.met_share > 0.8 && report.objects.median_abs_m.unwrap() < 0.05, "{:?}", report.objects);
    assert!(report.lost_shots_known);
    // Both sides open as data sets with the same ids and boxes.
    let [measured, sim] = ["measured", "sim"].map(|side| Dataset::open(&out.join(side)).unwrap());
    assert_eq!(measured.all_ids().unwrap(), sim.all_ids().unwrap());
    for id in measured.all_ids().unwrap() {
        let [a, b] = [&measured, &sim].map(|side| side.load(&id).unwrap());
        assert_eq!(a.objects, b.objects);
        assert_eq!(a.objects.len(), 1);
        let share = b.cloud.len() as f64 / a.cloud.len() as f64;
        assert!((share - 1.0).abs() < 0.03, "{share}");
    }
    // The sensor can be simulated.
    let rig = sensor::Rig::read(&out.join("sensor.toml")).unwrap();
    assert_eq!(rig.sensors[0].pattern.as_ref().unwrap().shots().len(), 24 * 400);
    assert!(out.join("maps/map_000.ply").is_file() && out.join("unknown/000000.bin").is_file());
    // The same twin again: the same bytes; with another map: refused.
    let cloud = || std::fs::read(out.join("sim/velodyne/000004.bin")).unwrap();
    let before = cloud();
    std::fs::remove_file(out.join("sim/velodyne/000004.bin")).unwrap();
    twin_of(&root, &out, None, KEEP);
    assert!(cloud() == before);
    let recording = Recording::open(Dataset::open(&root).unwrap(), None, KEEP).unwrap();
    let other = TwinConfig { leave: Leave::Seconds(0.3), fusion: FusionConfig::default(), write_maps: false };
    let error = pair::make(&recording, &other, &out, &|_, _| ()).unwrap_err().to_string();
    assert!(error.contains("with other options, poses or another version"), "{error}");
}

#[test]
fn too_few_frames_are_refused_and_no_labels_are_said() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path().join("room");
    write_recording(&root, 4);
    let open = |frames| Recording::open(Dataset::open(&root).unwrap(), Some(frames), KEEP);
    let error = open(3).err().expect("three frames are too few").to_string();
    assert!(error.contains("3 frames; a twin is made of at least 4"), "{error}");
    std::fs::remove_file(root.join("labels.csv")).unwrap();
    let report = twin_of(&root, &folder.path().join("out"), None, KEEP);
    assert!(report.notes.iter().any(|n| n.contains("no tracked boxes")), "{:?}", report.notes);
}

#[test]
fn real_scans_are_met() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data/kitti_raw_0001");
    if !root.is_dir() {
        eprintln!("skipped: {} is absent", root.display());
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let report = twin_of(&root, &folder.path().join("out"), Some(8), PoseOptions { odometry: false, refine: true });
    let world = report.static_world;
    assert!(world.median_abs_m.unwrap() < 0.07 && world.within_10_cm.unwrap() > 0.6, "{world:?}");
    assert!(world.met_share > 0.9 && world.twin_met_share > 0.85, "{world:?}");
    assert!(report.lost_shots_known);
}
