//! Each fault that is put into a synthetic data set is found; a data set without faults has no findings.

use super::*;
use crate::write::{write_bin, write_dataset_toml, write_kitti_text, write_split};
use crate::{Calibration, Cloud, DatasetConfig, Frame, LabelBox, LabelFrame, Layout, Object, stream};
use geometry::Box3;
use rand::RngExt;
use std::f64::consts::FRAC_PI_2;
use std::path::{Path, PathBuf};

/// Ground, walls and six cars with random yaw.
fn scene(seed: u64) -> Frame {
    let mut rng = stream(seed, "scene", 0, 0);
    let mut values = Vec::new();
    let mut point = |p: [f64; 3]| values.extend([p[0] as f32, p[1] as f32, p[2] as f32, 0.5]);
    for _ in 0..6000 {
        let (x, y) = (rng.random_range(1.0..60.0), rng.random_range(-20.0..20.0));
        point([x, y, -1.7 + rng.random_range(-0.02..0.02)]);
    }
    for _ in 0..8 {
        let (x, y) =
            (rng.random_range(2.0..50.0), rng.random_range(14.0..20.0) * if rng.random() { 1.0 } else { -1.0 });
        (0..150).for_each(|i| point([x + 0.05 * f64::from(i), y, -1.6 + 0.02 * f64::from(i % 100)]));
    }
    let mut objects = Vec::new();
    for i in 0..6 {
        let yaw = rng.random_range(-3.1..3.1);
        let y = [-6.0, 6.0, 0.0][i % 3] + rng.random_range(-1.0..1.0);
        let bbox = Box3::from_array([8.0 + 7.5 * i as f64, y, -0.95, 4.0, 1.7, 1.5, yaw]);
        for _ in 0..150 {
            let mut local = [0, 1, 2].map(|k| rng.random_range(-0.49..0.49) * bbox.size[k]);
            let side = rng.random_range(0..2);
            local[side] = 0.49 * bbox.size[side] * local[side].signum();
            point(bbox.from_local(local));
        }
        objects.push(Object { class: "Car".into(), bbox, truncation: Some(0.0), occlusion: Some(0), image_box: None });
    }
    Frame { id: format!("{seed:06}"), cloud: Cloud { values, channels: 4 }, objects }
}

const FRAMES: u64 = 6;

/// A valid data set: train has frames 0 to 3, val 4 and 5.
fn data_set(label_frame: LabelFrame) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    for seed in 0..FRAMES {
        let frame = scene(seed);
        Layout::Kitti.write_frame(root, &frame).unwrap();
        if label_frame == LabelFrame::Camera {
            crate::write_atomic(
                &root.join(format!("calib/{}.txt", frame.id)),
                crate::calibration::tests::MADE_UP.as_bytes(),
            )
            .unwrap();
            let calibration = Calibration::parse(crate::calibration::tests::MADE_UP, Path::new("c")).unwrap();
            let line = |o: &Object| calibration.camera_from_lidar_box(&o.class, &o.bbox, None, [1242, 375]);
            let lines: Vec<_> = frame.objects.iter().map(line).collect();
            write_kitti_text(&labels(root, seed), &lines).unwrap();
        }
    }
    write_split(&root.join("ImageSets/train.txt"), &["000000", "000001", "000002", "000003"]).unwrap();
    write_split(&root.join("ImageSets/val.txt"), &["000004", "000005"]).unwrap();
    let config =
        DatasetConfig { name: "made-up".into(), label_frame, classes: vec!["Car".into()], ..DatasetConfig::default() };
    write_dataset_toml(&root.join("dataset.toml"), &config).unwrap();
    folder
}

fn labels(root: &Path, seed: u64) -> PathBuf {
    root.join(format!("label_2/{seed:06}.txt"))
}

fn change_labels(root: &Path, change: impl Fn(&mut LabelBox)) {
    let dataset = Dataset::open(root).unwrap();
    for seed in 0..FRAMES {
        let mut lines = dataset.labels(&format!("{seed:06}")).unwrap();
        lines.iter_mut().for_each(&change);
        write_kitti_text(&labels(root, seed), &lines).unwrap();
    }
}

fn examine(root: &Path) -> DoctorReport {
    doctor(&Dataset::open(root).unwrap(), None).unwrap()
}

#[track_caller]
fn finds(report: &DoctorReport, severity: Severity, check: &str, text: &str) {
    let found = |f: &Finding| f.severity == severity && f.check == check && f.message.contains(text);
    assert!(report.findings.iter().any(found), "no {check} with {text:?} in\n{report}");
    assert!(severity == Severity::Note || !report.sound);
}

fn car(range: [f64; 6], size: [f64; 3], bottom: f64) -> DetectorFacts {
    DetectorFacts {
        classes: vec!["Car".into()],
        range,
        anchors: vec![AnchorFacts { class: "Car".into(), size, bottom }],
    }
}

#[test]
fn valid_data_have_no_findings() {
    for label_frame in [LabelFrame::Lidar, LabelFrame::Camera] {
        let folder = data_set(label_frame);
        let dataset = Dataset::open(folder.path()).unwrap();
        let detector = car([0.0, -40.0, -3.0, 70.0, 40.0, 1.0], [3.9, 1.6, 1.56], -1.78);
        let report = doctor(&dataset, Some(&detector)).unwrap();
        assert!(report.sound && report.findings.is_empty(), "{report}");
        assert!(report.readings[0].declared && report.readings[0].share > 0.99, "{:?}", report.readings);
        assert!(report.verdict.contains("Nothing is wrong with made-up: 6 frames, 36 boxes"), "{report}");
        assert_eq!((report.splits["train"], report.classes[0].boxes), (4, 36));
        serde_json::to_string(&report).unwrap();
    }
}

#[test]
fn wrong_conventions_are_recognised_from_the_points() {
    type Change = (LabelFrame, fn(&mut LabelBox), &'static str);
    let changes: [Change; 8] = [
        (LabelFrame::Lidar, |l| l.rotation_y *= -1.0, "clockwise"),
        (LabelFrame::Lidar, |l| l.rotation_y += FRAC_PI_2, "swapped"),
        (LabelFrame::Lidar, |l| l.size_hwl.swap(1, 2), "swapped"),
        (LabelFrame::Lidar, |l| l.size_hwl.swap(0, 2), "sizes are length, width, height"),
        (LabelFrame::Lidar, |l| l.location[2] -= l.size_hwl[0] / 2.0, "the box's bottom in the cloud's frame"),
        (LabelFrame::Lidar, |l| l.rotation_y = -l.rotation_y - FRAC_PI_2, "rotation is KITTI's"),
        (LabelFrame::Camera, |l| l.location[1] -= l.size_hwl[0] / 2.0, "centre of the box in the camera's frame"),
        (LabelFrame::Camera, |l| l.rotation_y *= -1.0, "with the other sign"),
    ];
    for (label_frame, change, text) in changes {
        let folder = data_set(label_frame);
        change_labels(folder.path(), change);
        finds(&examine(folder.path()), Severity::Problem, "label frame", text);
    }
    for label_frame in [LabelFrame::Lidar, LabelFrame::Camera] {
        let folder = data_set(label_frame);
        let mut dataset = Dataset::open(folder.path()).unwrap();
        // With a calibration both label frames are possible.
        for seed in 0..FRAMES {
            let path = folder.path().join(format!("calib/{seed:06}.txt"));
            crate::write_atomic(&path, crate::calibration::tests::MADE_UP.as_bytes()).unwrap();
        }
        let (other, text) = match label_frame {
            LabelFrame::Lidar => (LabelFrame::Camera, "centre of the box in the cloud's frame"),
            LabelFrame::Camera => (LabelFrame::Lidar, "the box's bottom in the camera's frame"),
        };
        dataset.config.label_frame = other;
        finds(&doctor(&dataset, None).unwrap(), Severity::Problem, "label frame", text);
    }
    let folder = data_set(LabelFrame::Lidar);
    change_labels(folder.path(), |l| l.location[0] += 200.0);
    finds(&examine(folder.path()), Severity::Problem, "label frame", "no known convention");
}

#[test]
fn boxes_in_the_wrong_place_are_found() {
    let folder = data_set(LabelFrame::Lidar);
    change_labels(folder.path(), |l| l.location[2] += 1.2);
    finds(&examine(folder.path()), Severity::Problem, "boxes far from the ground", "36 of 36");

    let folder = data_set(LabelFrame::Lidar);
    change_labels(folder.path(), |l| l.location[1] += if l.location[0] < 10.0 { 30.0 } else { 0.0 });
    finds(&examine(folder.path()), Severity::Problem, "boxes without points", "6 of 36");

    let folder = data_set(LabelFrame::Lidar);
    change_labels(folder.path(), |l| l.size_hwl = l.size_hwl.map(|s| s * 100.0));
    finds(&examine(folder.path()), Severity::Problem, "sizes", "above 40 m");

    let folder = data_set(LabelFrame::Lidar);
    change_labels(folder.path(), |l| l.class = "Van".into());
    finds(
        &examine(folder.path()),
        Severity::Problem,
        "classes",
        "no box is of a listed class (Car); the labels have Van",
    );
    change_labels(folder.path(), |l| l.class = if l.location[0] < 10.0 { "Van" } else { "Car" }.into());
    finds(&examine(folder.path()), Severity::Note, "classes", "Van (6 boxes)");

    let folder = data_set(LabelFrame::Lidar);
    (0..FRAMES).for_each(|seed| std::fs::write(labels(folder.path(), seed), "").unwrap());
    finds(&examine(folder.path()), Severity::Problem, "labels", "has no labelled box");
    std::fs::remove_dir_all(folder.path().join("label_2")).unwrap();
    finds(&examine(folder.path()), Severity::Problem, "labels", "no folder of labels");
}

#[test]
fn a_detector_that_does_not_fit_is_reported() {
    let folder = data_set(LabelFrame::Lidar);
    let dataset = Dataset::open(folder.path()).unwrap();
    let wide = [0.0, -40.0, -3.0, 70.0, 40.0, 1.0];
    let examine = |detector: DetectorFacts| doctor(&dataset, Some(&detector)).unwrap();
    finds(
        &examine(car([0.0, -40.0, -3.0, 30.0, 40.0, 1.0], [3.9, 1.6, 1.56], -1.7)),
        Severity::Problem,
        "boxes outside of the range",
        "18 of 36",
    );
    finds(&examine(car(wide, [1.6, 3.9, 1.56], -1.7)), Severity::Problem, "anchors", "too little to be matched");
    finds(&examine(car(wide, [3.9, 1.6, 4.0], -1.7)), Severity::Problem, "anchors", "4 m high");
    finds(&examine(car(wide, [3.9, 1.6, 1.56], 0.0)), Severity::Problem, "anchors", "% of the height is shared");
    finds(&examine(car(wide, [3.9, 1.6, 1.56], -1.0)), Severity::Note, "anchors", "% of the height is shared");
    let three = DetectorFacts { classes: vec!["Car".into(), "Cyclist".into()], range: wide, anchors: Vec::new() };
    finds(&examine(three), Severity::Problem, "classes", "the detector's Cyclist");
}

#[test]
fn duplicate_frames_are_found() {
    let folder = data_set(LabelFrame::Lidar);
    let root = folder.path();
    let cloud = root.join("velodyne/000005.bin");
    std::fs::copy(root.join("velodyne/000002.bin"), &cloud).unwrap();
    std::fs::copy(labels(root, 2), labels(root, 5)).unwrap();
    finds(
        &examine(root),
        Severity::Problem,
        "duplicates",
        "exactly the cloud of a frame of another split: 000002 (train) and 000005 (val)",
    );

    let mut noisy = scene(2).cloud;
    let mut rng = stream(1, "noise", 0, 0);
    noisy.points_mut().for_each(|p| p[..3].iter_mut().for_each(|v| *v += rng.random_range(-0.03..0.03)));
    noisy.retain(|_, _| rng.random_bool(0.9));
    write_bin(&cloud, &noisy).unwrap();
    finds(
        &examine(root),
        Severity::Problem,
        "duplicates",
        "nearly the same scene as a frame of another split: 000002 (train) and 000005 (val)",
    );

    std::fs::copy(root.join("velodyne/000003.bin"), root.join("velodyne/000002.bin")).unwrap();
    std::fs::copy(labels(root, 3), labels(root, 2)).unwrap();
    finds(
        &examine(root),
        Severity::Note,
        "duplicates",
        "exactly the cloud of another frame: 000002 (train) and 000003 (train)",
    );

    write_split(&root.join("ImageSets/val.txt"), &["000004", "000001", "000004"]).unwrap();
    let report = examine(root);
    finds(&report, Severity::Problem, "duplicates", "1 frames are in more than one split: 000001");
    finds(&report, Severity::Problem, "splits", "more than once: 000004");
    finds(&report, Severity::Note, "splits", "1 of 6 frames are in no split");
}

#[test]
fn bad_files_are_named_and_the_rest_is_examined() {
    let folder = data_set(LabelFrame::Lidar);
    let root = folder.path();
    std::fs::write(root.join("velodyne/000001.bin"), [0; 15]).unwrap();
    std::fs::remove_file(labels(root, 2)).unwrap();
    std::fs::write(labels(root, 3), "Car 0 0\n").unwrap();
    std::fs::write(root.join("ImageSets/val.txt"), "").unwrap();
    let report = examine(root);
    finds(&report, Severity::Problem, "bad files", "3 of 6 frames cannot be used");
    for text in ["000001.bin", "000002.txt", "000003.txt:1"] {
        finds(&report, Severity::Problem, "bad files", text);
    }
    finds(&report, Severity::Problem, "splits", "val.txt: the split is empty");
    assert_eq!(report.boxes, 18);
}

#[test]
fn real_scans_have_no_problems_and_added_faults_are_found() {
    let root = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data/kitti"));
    if !root.exists() {
        return eprintln!("skipped: {} is not there", root.display());
    }
    let dataset = Dataset::open(root).unwrap();
    let report = doctor(&dataset, None).unwrap();
    assert!(report.sound, "{report}");

    // The same scans with labels in the LiDAR frame, then with each fault in turn.
    let folder = tempfile::tempdir().unwrap();
    let frames: Vec<Frame> = dataset.all_ids().unwrap().iter().map(|id| dataset.load(id).unwrap()).collect();
    frames.iter().for_each(|frame| Layout::Kitti.write_frame(folder.path(), frame).unwrap());
    let with = |change: fn(&mut LabelBox)| {
        for frame in &frames {
            let mut lines = crate::write::label_boxes(frame);
            lines.iter_mut().for_each(change);
            write_kitti_text(&folder.path().join(format!("label_2/{}.txt", frame.id)), &lines).unwrap();
        }
        examine(folder.path())
    };
    let sound = with(|_| ());
    assert!(sound.sound && sound.readings[0].declared, "{sound}");
    finds(&with(|l| l.rotation_y += FRAC_PI_2), Severity::Problem, "label frame", "swapped");
    finds(&with(|l| l.size_hwl.swap(1, 2)), Severity::Problem, "label frame", "swapped");
    finds(&with(|l| l.size_hwl.swap(0, 2)), Severity::Problem, "label frame", "sizes are length");
    finds(
        &with(|l| l.location[2] -= l.size_hwl[0] / 2.0),
        Severity::Problem,
        "label frame",
        "bottom in the cloud's frame",
    );
    finds(&with(|l| l.rotation_y *= -1.0), Severity::Problem, "label frame", "clockwise");
    finds(&with(|l| l.location[2] += 1.5), Severity::Problem, "boxes far from the ground", "of 17");
}
