//! Twins of a made-up recording with exact ranges, and of real scans.

mod room;

use data::Dataset;
use lidarshift_twin::map::FusionConfig;
use lidarshift_twin::{Leave, PoseOptions, PoseSource, Recording, TwinConfig, TwinReport, pair};
use room::write_recording;
use std::path::Path;

const KEEP: PoseOptions = PoseOptions { odometry: false, refine: false };

fn twin_of(root: &Path, out: &Path, frames: Option<usize>, options: PoseOptions) -> TwinReport {
    let recording = Recording::open(Dataset::open(root).unwrap(), None, frames, options).unwrap();
    let config =
        TwinConfig { leave: Leave::Alternate, fusion: FusionConfig::default(), most_bytes: 1 << 30, write_maps: true };
    pair::make(&recording, &config, out, &|_, _| ()).unwrap()
}

#[test]
fn a_room_is_shown_as_it_is_and_a_lost_shot_has_no_surface_where_nobody_saw_one() {
    let folder = tempfile::tempdir().unwrap();
    let (root, out) = (folder.path().join("room"), folder.path().join("twin"));
    write_recording(&root, 10, 1.0, 0.0);
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
    let recording = Recording::open(Dataset::open(&root).unwrap(), None, None, KEEP).unwrap();
    let other = TwinConfig {
        leave: Leave::Seconds(0.3),
        fusion: FusionConfig::default(),
        most_bytes: 1 << 30,
        write_maps: false,
    };
    let error = pair::make(&recording, &other, &out, &|_, _| ()).unwrap_err().to_string();
    assert!(error.contains("with other options, poses or another version"), "{error}");
}

#[test]
fn too_few_frames_are_refused_and_no_labels_are_said() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path().join("room");
    write_recording(&root, 4, 1.0, 0.0);
    let open = |frames| Recording::open(Dataset::open(&root).unwrap(), None, Some(frames), KEEP);
    let error = open(1).err().expect("one frame is too few").to_string();
    assert!(error.contains("1 frames; a twin is made of at least 2"), "{error}");
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

/// Recordings of which only a scan or two are at hand.
#[test]
fn single_scans_are_refused_and_two_sweeps_make_a_twin() {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data");
    if !data.is_dir() {
        eprintln!("skipped: {} is absent", data.display());
        return;
    }
    let refine = PoseOptions { odometry: false, refine: true };
    let folder = tempfile::tempdir().unwrap();
    // A scan of SemanticKITTI at its place in a sequence.
    let sequence = folder.path().join("08");
    for (name, ending, inside) in [("velodyne", "bin", "000000.bin"), ("labels", "label", "000000.label")] {
        std::fs::create_dir_all(sequence.join(name)).unwrap();
        let scan = data.join(format!("semantickitti/semantickitti_08_000000.{ending}"));
        std::fs::copy(scan, sequence.join(name).join(inside)).unwrap();
    }
    std::fs::write(sequence.join("calib.txt"), "Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n").unwrap();
    let others = ["nuscenes_keyframe", "argoverse2/adcf7d18-0510-35b0-a2fa-b4cea13a6d76"].map(|name| data.join(name));
    for single in others.into_iter().chain([sequence]) {
        let dataset = Dataset::open(&single).unwrap();
        let error = Recording::open(dataset, None, None, refine).err().expect("one scan").to_string();
        assert!(error.contains("1 frames; a twin is made of at least 2"), "{}: {error}", single.display());
    }
    let log = data.join("argoverse2/7fab2350-7eaf-3b7e-a39d-6937a4c1bede");
    let report = twin_of(&log, &folder.path().join("out"), None, refine);
    eprintln!("{report:#?}");
    assert_eq!((report.frames, report.poses), (2, PoseSource::Recording));
    assert!(report.lost_shots_known && report.static_world.met_share > 0.6, "{report:?}");
    assert!(report.notes.iter().any(|n| n.contains("hardly more than one scan")), "{:?}", report.notes);
}

#[test]
fn the_motion_of_a_track_is_that_between_the_frames_around() {
    let folder = tempfile::tempdir().unwrap();
    write_recording(folder.path(), 4, 1.0, 0.0);
    std::fs::write(folder.path().join("times.txt"), "0.0\n0.1\n0.2\n0.3\n").unwrap();
    // The sensor drives at 10 m/s along x; the object keeps its distance and is turned by 90 degrees.
    let line = |frame: usize| format!("{frame},7,Car,10,2,-1,4,2,1.5,{}\n", std::f64::consts::FRAC_PI_2);
    let header = "frame,track,class,cx,cy,cz,l,w,h,yaw\n";
    std::fs::write(folder.path().join("labels.csv"), header.to_string() + &(0..4).map(line).collect::<String>())
        .unwrap();
    let recording = Recording::open(Dataset::open(folder.path()).unwrap(), None, None, KEEP).unwrap();
    for frame in 0..4 {
        let twist = recording.object_twist(frame, "7");
        // In the frame of the box: to its right.
        let off = (twist - nalgebra::Vector6::new(0.0, -10.0, 0.0, 0.0, 0.0, 0.0)).norm();
        assert!(off < 1e-6, "{frame}: {twist}");
    }
    assert_eq!(recording.object_twist(1, "8"), nalgebra::Vector6::zeros());
}
