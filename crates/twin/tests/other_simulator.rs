//! The twin of ten scans that another simulator made: exact poses, boxes, times and rows.

use data::Dataset;
use geometry::{Box3, Pose, move_box};
use lidarshift_twin::map::FusionConfig;
use lidarshift_twin::{Leave, PoseOptions, Recording, TwinConfig, World, pair, plan};
use serde_json::Value;
use std::fmt::Write;
use std::path::{Path, PathBuf};

const FRAMES: usize = 10;

/// Scans take 0.1 s; poses and boxes are those of the middle.
const MIDDLE_S: f32 = 0.05;

/// Bytes of a point: x, y, z (f32), ring (u16), t (f32), class (u8), instance (u16).
const RECORD: usize = 21;

/// Writes the scans as a recording, with or without labels.
fn convert(from: &Path, root: &Path, labelled: bool) {
    for folder in ["velodyne", "ring", "time_s"] {
        std::fs::create_dir_all(root.join(folder)).unwrap();
    }
    for frame in 0..FRAMES {
        let bytes = std::fs::read(from.join(format!("{frame:06}.npy"))).unwrap();
        let header = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
        assert!(bytes[..header].windows(14).any(|w| w == b"('inst', '<u2'"), "another order of fields");
        let (mut cloud, mut ring, mut time) = (Vec::new(), Vec::new(), Vec::new());
        for p in bytes[header..].chunks_exact(RECORD) {
            cloud.extend_from_slice(&p[..12]);
            cloud.extend(0.5f32.to_le_bytes());
            ring.extend_from_slice(&p[12..14]);
            let t = f32::from_le_bytes(p[14..18].try_into().unwrap());
            time.extend((t - MIDDLE_S).to_le_bytes());
        }
        for (folder, content) in [("velodyne", cloud), ("ring", ring), ("time_s", time)] {
            std::fs::write(root.join(format!("{folder}/{frame:06}.bin")), content).unwrap();
        }
    }
    let poses = std::fs::read_to_string(from.join("poses_mid_scan.txt")).unwrap();
    std::fs::write(root.join("poses.txt"), poses).unwrap();
    let times: Vec<String> = (0..FRAMES).map(|f| format!("{}", 0.1 * f as f64)).collect();
    std::fs::write(root.join("times.txt"), times.join("\n")).unwrap();
    if labelled {
        std::fs::write(root.join("labels.csv"), labels(from)).unwrap();
    }
}

fn objects(from: &Path, frame: usize) -> Vec<Value> {
    let text = std::fs::read_to_string(from.join("labels.json")).unwrap();
    let all: Value = serde_json::from_str(&text).unwrap();
    all[frame].as_array().unwrap().clone()
}

fn labels(from: &Path) -> String {
    let mut text = String::from("frame,track,class,cx,cy,cz,l,w,h,yaw\n");
    for frame in 0..FRAMES {
        for o in objects(from, frame) {
            let b = box_of(&o);
            let ([x, y, z], [l, w, h], class) = (b.center, b.size, o["cls"].as_str().unwrap());
            writeln!(text, "{frame},{},{class},{x},{y},{z},{l},{w},{h},{}", o["id"], b.yaw_rad).unwrap();
        }
    }
    text
}

fn box_of(o: &Value) -> Box3 {
    let three = |name: &str| [0, 1, 2].map(|k: usize| o[name][k].as_f64().unwrap());
    Box3 { center: three("center"), size: three("lwh"), yaw_rad: o["yaw"].as_f64().unwrap() }
}

/// Share of the surfels of a map that are where a driving car was in one of its frames, above the ground: of all
/// surfels, and of those that stop more than half of the shots.
fn ghosts(recording: &Recording, job: &plan::Job, world: &World, from: &Path) -> [f64; 2] {
    let poses = recording.world_from_lidar();
    let map_from_world: Pose = poses[job.map[job.map.len() / 2]].inverse();
    let driving = |frame: &usize| {
        let map_from_lidar = map_from_world * poses[*frame];
        let cars = objects(from, *frame).into_iter().filter(|o| !o["name"].as_str().unwrap().starts_with("park"));
        cars.map(move |o| move_box(&map_from_lidar, &box_of(&o))).collect::<Vec<_>>()
    };
    let boxes: Vec<Box3> = job.map.iter().flat_map(driving).collect();
    let inside = |place: [f32; 3]| {
        boxes.iter().any(|b| {
            let [x, y, z] = b.to_local(place.map(f64::from));
            let [l, w, h] = b.size;
            x.abs() < l / 2.0 + 0.3 && y.abs() < w / 2.0 + 0.2 && z > 0.2 - h / 2.0 && z < h / 2.0 + 0.2
        })
    };
    let map = world.map();
    [0.0, 0.5].map(|least| {
        let opaque: Vec<usize> = (0..map.surfels().len()).filter(|i| map.opacity(*i) > least).collect();
        let ghosts = opaque.iter().filter(|i| inside(map.surfels()[**i].place)).count();
        ghosts as f64 / opaque.len() as f64
    })
}

fn data() -> Option<PathBuf> {
    let from = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data/mujoco_street");
    if !from.is_dir() {
        eprintln!("skipped: {} is absent", from.display());
        return None;
    }
    Some(from)
}

#[test]
fn the_exact_scene_is_met_and_driving_cars_leave_no_ghosts() {
    let Some(from) = data() else { return };
    for (labelled, refine) in [(true, true), (true, false), (false, false)] {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("street");
        convert(&from, &root, labelled);
        let options = PoseOptions { odometry: false, refine };
        let recording = Recording::open(Dataset::open(&root).unwrap(), None, None, options).unwrap();
        let (leave, fusion) = (Leave::Alternate, FusionConfig::default());
        let config = TwinConfig { leave, fusion, most_bytes: 1 << 30, write_maps: false };
        let report = pair::make(&recording, &config, &folder.path().join("twin"), &|_, _| ()).unwrap();
        let times: Vec<f64> = recording.moments().iter().map(|m| m.stamp_s.unwrap()).collect();
        let jobs = plan::jobs(&times, leave);
        let world = World::build(&recording, &jobs[0], &fusion, 1 << 30).unwrap();
        let ghosts = ghosts(&recording, &jobs[0], &world, &from);
        eprintln!("labelled {labelled}, refined {refine}: ghosts {ghosts:.5?}");
        eprintln!("static {:?}\nobjects {:?}\n{:?}", report.static_world, report.objects, report.wall_thickness_m);
        let still = report.static_world;
        assert!(still.median_abs_m.unwrap() < 0.03 && still.p90_abs_m.unwrap() < 0.25, "{still:?}");
        assert!(still.met_share > 0.95, "{still:?}");
        // Without labels the last place of a car that drives ahead is never seen empty.
        assert!(ghosts[0] < if labelled { 0.005 } else { 0.015 }, "{labelled}: {ghosts:?}");
        if labelled {
            let cars = report.objects;
            assert!(cars.median_abs_m.unwrap() < 0.03 && cars.met_share > 0.95, "{cars:?}");
        }
    }
}
