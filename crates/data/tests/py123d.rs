//! The logs that `tests/golden/py123d/make.py` wrote with py123d, and changes of them.

use lidarshift_data::{Dataset, Layout};
use serde::Deserialize;
use std::fs;
use std::path::{Path, PathBuf};

const SYNC: &str = "sync.arrow";
const BOXES: &str = "box_detections_se3.arrow";
const POSES: &str = "ego_state_se3.arrow";
const CLOUDS: &str = "lidar.lidar_merged.arrow";

#[derive(Deserialize)]
struct Expected {
    id: String,
    points: Vec<[f64; 6]>,
    boxes: Vec<(String, String, [f64; 7])>,
    place: [f64; 3],
    rotation: [[f64; 3]; 3],
}

fn golden() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden/py123d")
}

fn expected() -> Vec<Expected> {
    serde_json::from_str(&fs::read_to_string(golden().join("expected.json")).unwrap()).unwrap()
}

/// A copy of the logs.
fn copy() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    for name in ["curve", "still"] {
        fs::create_dir(folder.path().join(name)).unwrap();
        for file in fs::read_dir(golden().join("made_up_val").join(name)).unwrap().map(Result::unwrap) {
            fs::copy(file.path(), folder.path().join(name).join(file.file_name())).unwrap();
        }
    }
    folder
}

/// Points that are kept of a frame, and what is expected of them.
fn check_points(dataset: &Dataset, id: &str, points: &[[f64; 6]], has_whole: bool) {
    let (frame, details) = (dataset.load(id).unwrap(), dataset.point_details(id).unwrap());
    assert_eq!((frame.cloud.len(), frame.cloud.channels), (points.len(), if has_whole { 4 } else { 3 }), "{id}");
    let times = details.time_s.unwrap();
    for (i, (point, want)) in frame.cloud.points().zip(points).enumerate() {
        let off = (0..frame.cloud.channels).map(|axis| (f64::from(point[axis]) - want[axis]).abs()).fold(0.0, f64::max);
        assert!(off < 1e-5, "{id}: {point:?} is not {want:?}");
        assert!((f64::from(times[i]) - want[5]).abs() < 1e-6);
        assert_eq!(details.ring.as_ref().map_or(-1.0, |rings| f64::from(rings[i])), want[4]);
    }
    assert_eq!((details.ring.is_some(), details.compensated), (has_whole, None));
}

#[test]
fn logs_are_read_as_py123d_wrote_them() {
    let dataset = Dataset::open(&golden().join("made_up_val")).unwrap();
    let (config, expected) = (&dataset.config, expected());
    assert_eq!(config.layout, Layout::Py123d);
    let sequences = dataset.sequences().unwrap();
    assert_eq!(
        sequences.iter().map(|s| (s.name.as_str(), s.ids.len())).collect::<Vec<_>>(),
        [("curve", 3), ("still", 2)]
    );
    assert_eq!(dataset.all_ids().unwrap(), expected.iter().map(|e| e.id.clone()).collect::<Vec<_>>());
    for sequence in &sequences {
        let wanted: Vec<&Expected> = expected.iter().filter(|e| sequence.ids.contains(&e.id)).collect();
        for (moment, want) in dataset.moments(&sequence.ids).unwrap().iter().zip(wanted) {
            let pose = moment.world_from_lidar.unwrap();
            let off = (0..3).map(|i| (pose.translation.vector[i] - want.place[i]).abs()).fold(0.0, f64::max);
            let turned = pose.rotation.to_rotation_matrix();
            let skew = (0..9).map(|i| (turned[(i / 3, i % 3)] - want.rotation[i / 3][i % 3]).abs()).fold(0.0, f64::max);
            assert!(off < 1e-5 && skew < 1e-9, "{}: {pose}", want.id);
            assert_eq!(moment.objects.len(), want.boxes.len());
            for (object, (track, class, bbox)) in moment.objects.iter().zip(&want.boxes) {
                let off = object.bbox.to_array().iter().zip(bbox).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                assert!(off < 1e-5 && (&object.track, &object.class) == (track, class), "{object:?} is not {bbox:?}");
            }
        }
    }
    let stamps: Vec<f64> = dataset.moments(&sequences[0].ids).unwrap().iter().map(|m| m.stamp_s.unwrap()).collect();
    assert!(stamps.iter().zip([0.0, 0.2, 0.3]).all(|(stamp, want)| (stamp - want).abs() < 1e-12), "{stamps:?}");
}

#[test]
fn points_have_ring_time_and_intensity_where_the_log_has_them() {
    for (log, has_whole) in [("curve", true), ("still", false)] {
        let dataset = Dataset::open(&golden().join("made_up_val").join(log)).unwrap();
        for want in expected().iter().filter(|e| e.id.starts_with(log)) {
            // A log alone has no name.
            check_points(&dataset, want.id.rsplit_once('_').unwrap().1, &want.points, has_whole);
        }
    }
}

#[test]
fn a_sensor_is_read_alone() {
    let path = |sensor: &str| PathBuf::from(format!("{}#{sensor}", golden().join("made_up_val/curve").display()));
    let dataset = Dataset::open(&path("lidar_top")).unwrap();
    for want in expected().iter().filter(|e| e.id.starts_with("curve")) {
        let top: Vec<[f64; 6]> = want.points.iter().filter(|point| point[4] < 256.0).copied().collect();
        assert!(!top.is_empty() && top.len() < want.points.len());
        check_points(&dataset, want.id.rsplit_once('_').unwrap().1, &top, true);
    }
    // The origin is that of the sensor.
    let front = Dataset::open(&path("lidar_front")).unwrap();
    let pose = |dataset: &Dataset| dataset.moments(&dataset.all_ids().unwrap()).unwrap()[0].world_from_lidar.unwrap();
    let apart = pose(&dataset).inverse() * pose(&front);
    assert!((apart.translation.vector - nalgebra::Vector3::new(2.8, -0.05, -1.2)).norm() < 1e-9, "{apart}");
    let message = error(&path("lidar_back"));
    assert!(message.contains("has no sensor lidar_back: choose one of lidar_top, lidar_front"), "{message}");
}

/// What is wrong with the first frame of a log, or with the list of frames.
fn error(log: &Path) -> String {
    let read = || {
        let dataset = Dataset::open(log)?;
        let ids = dataset.all_ids()?;
        dataset.moments(&ids)?;
        ids.iter().try_for_each(|id| dataset.load(id).map(drop))
    };
    read().unwrap_err().to_string()
}

/// A file with `to` over the beginning of `from`, wherever it is: the schema is at both ends of a file.
fn replaced(bytes: &[u8], from: &[u8], to: &[u8]) -> Vec<u8> {
    let mut changed = bytes.to_vec();
    let places: Vec<usize> = (0..bytes.len()).filter(|at| bytes[*at..].starts_with(from)).collect();
    assert!(!places.is_empty() && to.len() <= from.len());
    places.into_iter().for_each(|at| changed[at..at + to.len()].copy_from_slice(to));
    changed
}

#[test]
fn what_is_missing_or_damaged_is_named() {
    let folder = copy();
    let curve = folder.path().join("curve");
    let [clouds, boxes] = [CLOUDS, BOXES].map(|name| fs::read(curve.join(name)).unwrap());
    // The third message, behind the schema and the head of the first batch, begins the stream with the first points.
    let stream = (0..clouds.len()).filter(|at| clouds[*at..].starts_with(&[0xff; 4])).nth(2).unwrap();
    let with_points = |mark: &[u8]| Some([&clouds[..stream], mark, &clouds[stream + mark.len()..]].concat());
    // The size of a buffer stands before its frame of Zstandard.
    let zstd = (stream..clouds.len()).find(|at| clouds[*at..].starts_with(&[0x28, 0xb5, 0x2f, 0xfd])).unwrap();
    let claim = [&clouds[..zstd - 8], &(1u64 << 50).to_le_bytes()[..], &clouds[zstd..]].concat();
    for (name, content, want) in [
        (CLOUDS, None, "has no table of a LiDAR (lidar.*.arrow)"),
        (POSES, None, "its boxes are in the world, but ego_state_se3.arrow has no pose for them"),
        (SYNC, Some(b"none".to_vec()), "is not a file of Arrow IPC, or is damaged: it is too short"),
        (CLOUDS, Some(clouds[..clouds.len() - 1].to_vec()), "it does not end with ARROW1"),
        (CLOUDS, with_points(b"LASF"), "its points are stored in LAZ: convert the log with lidar_codec=ipc_zstd"),
        (CLOUDS, with_points(b"DRACO"), "its points are stored in Draco"),
        (CLOUDS, Some(claim), "claims to have 1125899906842624"),
        (CLOUDS, Some(replaced(&clouds, b"lidar_to_imu", b"lidar_to_the")), "its metadata cannot be read"),
        (CLOUDS, Some(replaced(&clouds, b"metadata", b"metadate")), "has no metadata"),
        (BOXES, Some(replaced(&boxes, b"track_token", b"track_taken")), "has no column box_detections_se3.track_token"),
    ] {
        let path = curve.join(name);
        let valid = fs::read(&path).unwrap();
        match &content {
            Some(bytes) => fs::write(&path, bytes).unwrap(),
            None => fs::remove_file(&path).unwrap(),
        }
        let found = error(&curve);
        assert!(found.contains(want), "{name}: {found}");
        fs::write(&path, valid).unwrap();
    }
    let message = error(&golden().join("made_up_path/paths"));
    assert!(message.contains("column lidar.lidar_merged.data has the paths of the original files"), "{message}");
    let message = error(&folder.path().join("none"));
    assert!(message.contains("does not exist"), "{message}");
}

#[test]
fn classes_that_are_not_known_stay_numbers() {
    let folder = copy();
    let path = folder.path().join("still").join(BOXES);
    let bytes = fs::read(&path).unwrap();
    fs::write(&path, replaced(&bytes, b"registry.AV2Sensor", b"registry.AV3Sensor")).unwrap();
    let dataset = Dataset::open(&folder.path().join("still")).unwrap();
    let frame = dataset.load(&dataset.all_ids().unwrap()[0]).unwrap();
    assert_eq!(frame.objects.iter().map(|o| o.class.as_str()).collect::<Vec<_>>(), ["18", "18"]);
}
