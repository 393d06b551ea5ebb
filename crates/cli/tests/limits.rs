//! Inputs beyond the limits: each ends quickly with an error that names the file and the key.

#[allow(dead_code, reason = "each test file uses a part of it")]
mod program;

use program::{data_set, output_text, run};
use std::fs;
use std::path::Path;
use std::time::{Duration, Instant};

const TRAIN: &str = "train --dataset . --detector tiny.toml --epochs 1 --out run";

/// Applies `spoil` to the data set of a folder and runs the program, which must fail within seconds with each text of
/// `wanted`.
fn refused(spoil: impl Fn(&Path), arguments: &str, wanted: &[&str]) {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    spoil(dir.path());
    let begin = Instant::now();
    let output = run(dir.path(), arguments);
    let text = output_text(&output);
    assert_eq!(output.status.code(), Some(1), "{arguments}: {text}");
    assert!(begin.elapsed() < Duration::from_secs(30), "{arguments} took {:?}", begin.elapsed());
    assert!(!text.contains("panicked"), "{arguments}: {text}");
    for piece in wanted {
        assert!(text.contains(piece), "{arguments}: no {piece:?} in: {text}");
    }
}

/// A detector's TOML with one key changed.
fn detector(from: &'static str, to: &'static str) -> impl Fn(&Path) {
    move |f: &Path| {
        let text = fs::read_to_string(f.join("tiny.toml")).unwrap();
        assert!(text.contains(from));
        fs::write(f.join("tiny.toml"), text.replace(from, to)).unwrap();
    }
}

#[test]
fn sizes_of_detectors() {
    let named = |key: &'static str| ["tiny.toml", key];
    refused(detector("vfe_filters = 8", "vfe_filters = 1000000"), TRAIN, &named("network.vfe_filters = 1000000"));
    refused(
        detector("filters = [8, 16]", "filters = [8, 1000000]"),
        TRAIN,
        &named("network.backbone.filters = 1000000: at most 8192"),
    );
    refused(detector("strides = [2, 2]", "strides = [0, 2]"), TRAIN, &named("network.backbone: strides"));
    refused(detector("strides = [2, 2]", "strides = [2, 100000]"), TRAIN, &named("network.backbone.strides = 100000"));
    for size in ["[0.0, 0.32, 4.0]", "[1e-4, 1e-4, 4.0]"] {
        let spoil = |f: &Path| {
            let text = fs::read_to_string(f.join("tiny.toml")).unwrap();
            fs::write(f.join("tiny.toml"), text.replace("[0.32, 0.32, 4.0]", size)).unwrap();
        };
        refused(spoil, TRAIN, &["tiny.toml", "network.pillars"]);
    }
    refused(detector("max_train = 1000", "max_train = 1000000000"), TRAIN, &named("network.pillars.max_train"));
    refused(detector("batch_size = 2", "batch_size = 1000000000"), TRAIN, &named("optimization.batch_size"));
    for (assignment, message) in [
        ("network.backbone.layers=[0,1000]", "network.backbone.layers = 1000: at most 128"),
        ("network.pillars.max_points=1000000", "network.pillars.max_points = 1000000: at most 16384"),
        ("network.detection.nms_pre=10000000", "network.detection.nms_pre = 10000000: at most 1000000"),
        ("network.head.dir_bins=1000", "network.head.dir_bins = 1000: at most 256"),
        ("optimization.epochs=10000000", "optimization.epochs = 10000000: at most 1000000"),
    ] {
        refused(|_| (), &format!("{TRAIN} --set {assignment}").replace(" --epochs 1", ""), &["tiny.toml", message]);
    }
    let pointrcnn = |f: &Path| {
        let text = fs::read_to_string(f.join("tiny_pointrcnn.toml")).unwrap();
        let changed = text.replace("points = 256", "points = 1000000000");
        fs::write(f.join("tiny.toml"), changed).unwrap();
    };
    refused(pointrcnn, TRAIN, &named("network.sampling.points = 1000000000"));
}

#[test]
fn sizes_of_clouds() {
    let sparse = |f: &Path| {
        let file = fs::OpenOptions::new().write(true).open(f.join("velodyne/000002.bin")).unwrap();
        file.set_len(1 << 40).unwrap();
    };
    refused(sparse, TRAIN, &["velodyne/000002.bin", "1099511627776 bytes"]);
    let fields = |f: &Path| {
        let (names, more) = ((0..80_000).map(|i| format!(" f{i}")).collect::<String>(), 80_000);
        let header = format!(
            "VERSION 0.7\nFIELDS x y z{names}\nSIZE 4 4 4{}\nTYPE F F F{}\nCOUNT 1 1 1{}\nWIDTH 1\nHEIGHT 1\nDATA ascii\n",
            " 4".repeat(more),
            " F".repeat(more),
            " 1".repeat(more)
        );
        fs::remove_file(f.join("velodyne/000002.bin")).unwrap();
        fs::write(f.join("velodyne/000002.pcd"), header).unwrap();
    };
    refused(fields, TRAIN, &["velodyne/000002.pcd:2:", "FIELDS has 80003 names; at most 256"]);
    let boxes = |f: &Path| {
        let line = "Car 0 0 0 0 0 0 0 1.5 1.6 3.9 5 0 -1 0\n";
        fs::write(f.join("label_2/000003.txt"), line.repeat(100_001)).unwrap();
    };
    refused(boxes, TRAIN, &["label_2/000003.txt", "has 100001 boxes; at most 100000"]);
    let image = |f: &Path| fs::write(f.join("dataset.toml"), "layout = \"kitti\"\nimage_size = [70000, 1]\n").unwrap();
    refused(image, TRAIN, &["dataset.toml:2:", "image_size"]);
}

#[test]
fn many_boxes_and_names() {
    // Each label overlaps each detection: with time that grows with the square, this is done in seconds.
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    fs::create_dir(dir.path().join("found")).unwrap();
    let (mut labels, mut found) = (String::new(), String::new());
    for i in 0..2000 {
        let (x, y) = (5.0 * f64::from(i % 50) + 5.0, 4.0 * f64::from(i / 50));
        let line = format!("Car 0 0 0 0 0 100 50 1.5 1.6 3.9 {x} {y} -1 0");
        labels += &format!("{line}\n");
        found += &format!("{line} {}\n", f64::from(i + 1) / 2000.0);
    }
    fs::write(dir.path().join("label_2/000005.txt"), labels).unwrap();
    fs::write(dir.path().join("found/000005.txt"), found).unwrap();
    fs::write(dir.path().join("ids.txt"), "000005\n").unwrap();
    let eval = "eval ap --labels label_2 --label-frame lidar --detections found --ids ids.txt --json ap.json";
    program::must(dir.path(), eval);
    let ap: serde_json::Value = serde_json::from_slice(&fs::read(dir.path().join("ap.json")).unwrap()).unwrap();
    let is_all = |r: &&serde_json::Value| r["metric"] == "3d" && r["difficulty"] == "all" && r["n_gt"] == 2000;
    assert!(ap["rows"].as_array().unwrap().iter().any(|r| is_all(&r)), "{ap}");

    let names = |f: &Path| {
        let tensor = |i: u32| format!("\"tensor_{i}\":{{\"dtype\":\"F32\",\"shape\":[0],\"data_offsets\":[0,0]}}");
        let header = format!("{{{}}}", (0..1_000_000).map(tensor).collect::<Vec<_>>().join(","));
        let length = (header.len() as u64).to_le_bytes();
        fs::write(f.join("many.safetensors"), [&length[..], header.as_bytes()].concat()).unwrap();
    };
    let detect = "detect . --checkpoint many.safetensors --detector tiny.toml --out found";
    refused(names, detect, &["many.safetensors", "bytes with names of tensors; at most"]);
}

#[cfg(unix)]
#[test]
fn only_regular_files_are_read() {
    let fifo = |f: &Path| {
        assert!(std::process::Command::new("mkfifo").arg(f.join("cloud.pcd")).status().unwrap().success());
    };
    let detect = "detect cloud.pcd --checkpoint weights.safetensors --detector tiny.toml";
    // The weights are needed before the cloud is opened.
    let with_weights = |f: &Path| {
        program::must(f, "train --dataset . --detector tiny.toml --epochs 1 --out run");
        fs::copy(f.join("run/checkpoint/last.safetensors"), f.join("weights.safetensors")).unwrap();
        fifo(f);
    };
    refused(with_weights, detect, &["cloud.pcd", "is not a regular file"]);
    let labels = |f: &Path| {
        fs::remove_file(f.join("label_2/000003.txt")).unwrap();
        assert!(std::process::Command::new("mkfifo").arg(f.join("label_2/000003.txt")).status().unwrap().success());
    };
    refused(labels, TRAIN, &["label_2/000003.txt", "is not a regular file"]);
}

#[test]
fn meshes_and_tracks() {
    let race = |more: &str| {
        format!(
            "name = \"r\"\nrig = \"rig.toml\"\nframes = 6\n[track]\n{more}\n[race]\nframes = 60\nruns = 1\n[[dataset]]\nname = \"sim\"\n"
        )
    };
    let rig = concat!(env!("CARGO_MANIFEST_DIR"), "/../../configs/sensors/hdl64e.toml");
    let node = r#"{"asset":{"version":"2.0"},"scene":0,"scenes":[{"nodes":[0]}],"nodes":[{"children":[0]}]}"#;
    let with_car = |f: &Path| {
        fs::copy(rig, f.join("rig.toml")).unwrap();
        fs::write(f.join("car.gltf"), node).unwrap();
        fs::write(f.join("race.toml"), race("seed = 1").replace("[track]", "car = { file = \"car.gltf\" }\n[track]"))
            .unwrap();
    };
    refused(with_car, "simulate --config race.toml --out made", &["car.gltf", "nodes[0] is reached twice"]);
    let large_car = |f: &Path| {
        with_car(f);
        fs::File::options().write(true).open(f.join("car.gltf")).unwrap().set_len(2 << 30).unwrap();
    };
    refused(large_car, "simulate --config race.toml --out made", &["car.gltf", "has 2147483648 bytes"]);
    let long_track = |f: &Path| {
        fs::copy(rig, f.join("rig.toml")).unwrap();
        let mut csv = String::from("x_m,y_m,width_left_m,width_right_m\n");
        for i in 0..100 {
            let (s, c) = (f64::from(i) * std::f64::consts::TAU / 100.0).sin_cos();
            csv += &format!("{},{},5,5\n", 1.6e6 * c, 1.6e6 * s);
        }
        fs::write(f.join("track.csv"), csv).unwrap();
        fs::write(f.join("race.toml"), race("file = \"track.csv\"")).unwrap();
    };
    refused(long_track, "simulate --config race.toml --out made", &["track.csv", "m long; at most 100000 m"]);
}

#[test]
fn names_become_no_path() {
    let data_set = |name: &'static str| {
        move |f: &Path| fs::write(f.join("dataset.toml"), format!("layout = \"kitti\"\nname = \"{name}\"\n")).unwrap()
    };
    let train = "train --dataset . --detector tiny.toml --epochs 1";
    for name in ["../../../x", "/tmp/x", "a/b", "..", "a\\u001b[31m", "a\\nb"] {
        refused(data_set(name), train, &["dataset.toml:2:", "name: ", "is not a name for a file or folder"]);
    }
    for name in ["name = \"../x\"", "name = \"/x\"", "name = \"\"", "name = \"a\\u001b\""] {
        refused(detector("name = \"tiny\"", name), train, &["tiny.toml", "name: ", "is not a name"]);
    }
    let split = |f: &Path| {
        fs::write(f.join("dataset.toml"), "layout = \"kitti\"\n[splits]\n\"../x\" = \"ImageSets/train.txt\"\n")
            .unwrap();
    };
    refused(split, train, &["dataset.toml", "splits", "../x"]);
    let id = |f: &Path| fs::write(f.join("ImageSets/train.txt"), "000000\na\u{1b}b\n").unwrap();
    refused(id, train, &["ImageSets/train.txt:2:", "control character"]);
    let study = |f: &Path| {
        let text = "name = \"../s\"\nabout = []\n[[dataset]]\nname = \"a\"\nsource = { path = \".\" }\n";
        fs::write(f.join("study.toml"), text).unwrap();
    };
    refused(study, "study study.toml", &["study.toml", "name \"../s\""]);
}

#[test]
fn a_wrong_type_names_its_key() {
    let text = "layout = \"kitti\"\nclasses = \"Car\"\n";
    refused(|f| fs::write(f.join("dataset.toml"), text).unwrap(), TRAIN, &["dataset.toml:2: classes: invalid type"]);
}

#[test]
fn a_cloud_far_behind_does_not_fail_the_run() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    for i in 0..7 {
        let path = dir.path().join(format!("velodyne/{i:06}.bin"));
        let points = (0..200).flat_map(|k| [-300.0f32, (k % 3) as f32, -1.0, 0.5]);
        fs::write(path, points.flat_map(f32::to_le_bytes).collect::<Vec<u8>>()).unwrap();
    }
    program::must(dir.path(), TRAIN);
    assert!(dir.path().join("run/eval.json").is_file());
}
