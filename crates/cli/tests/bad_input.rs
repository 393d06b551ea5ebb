//! Invalid input: the error message names the file and the place, and the exit code is 1.

#[allow(dead_code, reason = "each test file uses a part of it")]
mod program;

use program::{data_set, must, output_text, program, run};
use std::fs;
use std::path::Path;

const TRAIN: &str = "train --dataset . --detector tiny.toml --epochs 1 --out run";

/// Applies `spoil` to a fresh data set, runs the program on it, and checks that its output contains each text of
/// `wanted`.
fn check(spoil: impl Fn(&Path), arguments: &str, wanted: &[&str]) {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    spoil(dir.path());
    let output = run(dir.path(), arguments);
    let text = output_text(&output);
    assert_eq!(output.status.code(), Some(1), "{arguments}: {text}");
    assert!(!text.contains("panicked"), "{arguments}: {text}");
    for piece in wanted {
        assert!(text.contains(piece), "{arguments}: no {piece:?} in: {text}");
    }
}

fn cloud(folder: &Path) -> std::path::PathBuf {
    folder.join("velodyne/000002.bin")
}

/// Writes `value` over the x of point 7.
fn set_x(folder: &Path, value: f32) {
    let mut bytes = fs::read(cloud(folder)).unwrap();
    bytes[7 * 16..7 * 16 + 4].copy_from_slice(&value.to_le_bytes());
    fs::write(cloud(folder), bytes).unwrap();
}

#[test]
fn clouds() {
    let truncated = |f: &Path| {
        let bytes = fs::read(cloud(f)).unwrap();
        fs::write(cloud(f), &bytes[..bytes.len() - 5]).unwrap();
    };
    check(truncated, TRAIN, &["velodyne/000002.bin", "bytes"]);
    check(|f| set_x(f, f32::NAN), TRAIN, &["velodyne/000002.bin", "point 7", "NaN"]);
    check(|f| set_x(f, f32::INFINITY), TRAIN, &["velodyne/000002.bin", "point 7", "inf"]);
    check(|f| set_x(f, 20_000.0), TRAIN, &["velodyne/000002.bin", "point 7", "10 km"]);
    check(|f| fs::write(cloud(f), "").unwrap(), TRAIN, &["velodyne/000002.bin", "no point"]);
    check(|f| set_x(f, f32::NAN), "doctor .", &["velodyne/000002.bin", "point 7"]);
}

#[test]
fn pcd_clouds() {
    let header = |fields: &str, size: &str, kind: &str, count: &str, points: &str, data: &str| {
        format!(
            "# .PCD v0.7\nVERSION 0.7\nFIELDS {fields}\nSIZE {size}\nTYPE {kind}\nCOUNT {count}\nWIDTH {points}\nHEIGHT 1\n\
             VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {data}\n"
        )
    };
    let xyz = |points: &str, data: &str, rows: &str| header("x y z", "4 4 4", "F F F", "1 1 1", points, data) + rows;
    for (text, wanted) in [
        (xyz("3", "ascii", "1 2 3\n4 5 6\n"), "has 2 points, but its header says 3"),
        (xyz("2", "ascii", "1 2 3\n4 5\n"), "cloud.pcd:13:"),
        (header("x y", "4 4", "F F", "1 1", "1", "ascii") + "1 2\n", "z"),
        (xyz("1", "binary_zipped", ""), "binary_zipped"),
        (xyz("2", "binary", "1234"), "bytes"),
        (xyz("99999999999", "binary", "1234"), "points in its header; at most"),
        ("no header".into(), "cloud.pcd"),
    ] {
        let train = "train --dataset . --detector tiny.toml --epochs 1 --out run --set channels=3";
        check_detect(&|f| fs::write(f.join("cloud.pcd"), &text).unwrap(), train, &["cloud.pcd", wanted]);
    }
}

/// As `check`, for `detect` on `cloud.pcd` with valid weights.
fn check_detect(spoil: &dyn Fn(&Path), train: &str, wanted: &[&str]) {
    use std::sync::OnceLock;
    static WEIGHTS: OnceLock<Vec<u8>> = OnceLock::new();
    let weights = WEIGHTS.get_or_init(|| {
        let dir = tempfile::tempdir().unwrap();
        data_set(dir.path());
        must(dir.path(), train);
        fs::read(dir.path().join("run/checkpoint/last.safetensors")).unwrap()
    });
    let spoil = |f: &Path| {
        fs::write(f.join("weights.safetensors"), weights).unwrap();
        let tiny = fs::read_to_string(f.join("tiny.toml")).unwrap().replace("channels = 4", "channels = 3");
        fs::write(f.join("tiny.toml"), tiny).unwrap();
        spoil(f);
    };
    check(spoil, "detect cloud.pcd --checkpoint weights.safetensors --detector tiny.toml", wanted);
}

#[test]
fn labels() {
    let line = |fields: &str| {
        let fields = fields.to_string();
        move |f: &Path| fs::write(f.join("label_2/000003.txt"), format!("{fields}\n")).unwrap()
    };
    for (fields, wanted) in [
        ("Car 0 0 0 0 0 0 0 1.5 1.6 3.9 5 0 -1", "has 15 values; this line has 14"),
        ("Car 0 0 0 0 0 0 0 tall 1.6 3.9 5 0 -1 0", "is 'tall', not a number"),
        ("Car 0 0 0 0 0 0 0 1.5 -1.6 3.9 5 0 -1 0", "a size cannot be negative"),
        ("Car 0 0 0 0 0 0 0 1.5 0 3.9 5 0 -1 0", "is 0; the size of a labelled object must be positive"),
        ("Car 0 0 0 0 0 0 0 1.5 1.6 3.9 nan 0 -1 0", "not a finite number"),
        ("Car 0 0 0 0 0 0 0 1.5 1.6 3.9 50000 0 -1 0", "farther than 10 km"),
    ] {
        check(line(fields), TRAIN, &["label_2/000003.txt:1:", wanted]);
    }
    check(|f| fs::remove_file(f.join("label_2/000003.txt")).unwrap(), TRAIN, &["label_2/000003.txt"]);
    let no_box = |f: &Path| {
        for i in 0..7 {
            fs::write(f.join(format!("label_2/{i:06}.txt")), "").unwrap();
        }
    };
    check(no_box, TRAIN, &["nothing to learn", "Car"]);
    check(no_box, "doctor .", &["has no labelled box"]);
    let far = line("Car 0 0 0 0 0 0 0 1.5 1.6 3.9 500 0 -1 0");
    check(far, "doctor . --detector tiny.toml", &["outside", "range"]);
}

#[test]
fn splits() {
    let split = |text: &'static str| move |f: &Path| fs::write(f.join("ImageSets/train.txt"), text).unwrap();
    check(split(""), TRAIN, &["ImageSets/train.txt", "the split is empty"]);
    check(split("000000\n../000001\n"), TRAIN, &["ImageSets/train.txt:2:", "../000001"]);
    check(split("000000\n000099\n"), TRAIN, &["ImageSets/train.txt:2:", "000099"]);
    check(|f| fs::remove_file(f.join("ImageSets/train.txt")).unwrap(), TRAIN, &["no split \"train\""]);
    check(|_| {}, "train --dataset nowhere --detector tiny.toml", &["nowhere", "does not exist"]);
}

#[test]
fn calibrations() {
    let camera = |calibration: &'static str| {
        move |f: &Path| {
            fs::write(f.join("dataset.toml"), "name = \"camera\"\nlayout = \"kitti\"\nlabel_frame = \"camera\"\n")
                .unwrap();
            fs::create_dir_all(f.join("calib")).unwrap();
            for i in 0..7 {
                fs::write(f.join(format!("calib/{i:06}.txt")), calibration).unwrap();
            }
        }
    };
    check(camera("R0_rect: 1 0 0 0 1 0 0 0 1\n"), TRAIN, &["calib/", "P2"]);
    let short = "P2: 721.5 0 609.5 44.8 0 721.5 172.8 0.21 0 0 1 0.0027\nR0_rect: 1 0 0 0 1 0 0 0\n";
    check(camera(short), TRAIN, &["calib/", ".txt:2:", "R0_rect"]);
}

#[test]
fn configurations() {
    let detector = |from: &'static str, to: &'static str| {
        move |f: &Path| {
            let text = fs::read_to_string(f.join("tiny.toml")).unwrap();
            assert!(text.contains(from));
            fs::write(f.join("tiny.toml"), text.replace(from, to)).unwrap();
        }
    };
    check(detector("vfe_filters = 8", "vfe_filter = 8"), TRAIN, &["tiny.toml", "vfe_filter"]);
    check(detector("channels = 4", "channels = \"four\""), TRAIN, &["tiny.toml", "channels", "four"]);
    check(detector("channels = 4", "channels = = 4"), TRAIN, &["tiny.toml:4:"]);
    check(detector("batch_size = 2", "batch_size = 0"), TRAIN, &["tiny.toml", "batch_size"]);
    let data_set = |text: &'static str| move |f: &Path| fs::write(f.join("dataset.toml"), text).unwrap();
    check(data_set("name = \"x\"\nlayout = \"kitti\"\ncolour = 1\n"), TRAIN, &["dataset.toml", "colour"]);
    check(data_set("name = 3\nlayout = \"kitti\"\n"), TRAIN, &["dataset.toml:1:", "integer `3`"]);
    check(data_set("name = \"x\"\nlayout = \"kitti\"\nclasses = [\"Van\"]\n"), TRAIN, &["Car", "Van"]);
    check(|_| {}, "train --dataset . --detector pointpillar", &["pointpillar", "pointpillars_small"]);
    check(|_| {}, &format!("{TRAIN} --set optimization.lr=1"), &["lr"]);
    check(|_| {}, &format!("{TRAIN} --device gpu"), &["no device \"gpu\""]);
}

#[test]
fn detections_as_text() {
    let eval = "eval ap --labels label_2 --label-frame lidar --detections found --json ap.json";
    let found = |line: &'static str| {
        move |f: &Path| {
            fs::create_dir(f.join("found")).unwrap();
            for i in 0..7 {
                fs::write(f.join(format!("found/{i:06}.txt")), format!("{line}\n")).unwrap();
            }
        }
    };
    let sound = "Car -1 -1 0 0 0 50 50 1.5 1.6 3.9 5 0 -1 0 0.9";
    check(found(sound.strip_suffix(" 0.9").unwrap()), eval, &["found/000000.txt:1:", "16", "15"]);
    check(found("Car -1 -1 0 0 0 50 50 1.5 1.6 3.9 5 0 -1 0 0.9 7"), eval, &["found/000000.txt:1:", "16", "17"]);
    check(found("Car -1 -1 0 0 0 50 50 1.5 1.6 3.9 5 0 -1 0 high"), eval, &["found/000000.txt:1:", "'high'"]);
    check(|_| {}, eval, &["found"]);
}

#[test]
fn checkpoints() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    must(dir.path(), TRAIN);
    let weights = dir.path().join("run/checkpoint/last.safetensors");
    let sound = fs::read(&weights).unwrap();
    let detect = |arguments: &str, wanted: &[&str]| {
        let output = run(dir.path(), arguments);
        let text = output_text(&output);
        assert_eq!(output.status.code(), Some(1), "{text}");
        assert!(wanted.iter().all(|piece| text.contains(piece)), "{arguments}: no {wanted:?} in: {text}");
    };
    let arguments = "detect velodyne/000001.bin --checkpoint";
    detect(&format!("{arguments} run/checkpoint/last.safetensors --detector pointpillars_small"), &["does not fit"]);
    for (name, bytes) in [
        ("short.safetensors", &sound[..sound.len() / 2]),
        ("header.safetensors", &sound[..20]),
        ("empty.pth", &[]),
        ("text.pth", b"weights".as_slice()),
    ] {
        fs::write(dir.path().join(name), bytes).unwrap();
        detect(&format!("{arguments} {name} --detector tiny.toml"), &[name]);
    }
    // A run with a damaged checkpoint cannot be resumed, and the checkpoint is not changed.
    let state = dir.path().join("run/checkpoint/state.json");
    let text = fs::read_to_string(&state).unwrap();
    fs::write(&state, &text[..text.len() / 2]).unwrap();
    detect(&format!("{TRAIN} --resume"), &["state.json", "damaged"]);
    assert_eq!(fs::read_to_string(&state).unwrap(), text[..text.len() / 2]);
}

/// Simulates a full file system: no file may grow beyond 64 KiB.
#[cfg(target_os = "linux")]
#[test]
fn full_disk() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    must(dir.path(), TRAIN);
    let before = fs::read(dir.path().join("run/checkpoint/last.safetensors")).unwrap();
    let limited = |arguments: &str| {
        let shell = format!("trap '' XFSZ; ulimit -f 8; exec {} {arguments}", env!("CARGO_BIN_EXE_lidarshift"));
        std::process::Command::new("bash").args(["-c", &shell]).current_dir(dir.path()).output().unwrap()
    };
    let output = limited("train --dataset . --detector tiny.toml --epochs 2 --out second");
    let text = output_text(&output);
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert!(text.contains("second") && text.to_lowercase().contains("file too large"), "{text}");
    // With enough space the same command resumes the run, and other runs are intact.
    must(dir.path(), "train --dataset . --detector tiny.toml --epochs 2 --out second --resume");
    assert_eq!(fs::read(dir.path().join("run/checkpoint/last.safetensors")).unwrap(), before);
}

#[test]
fn run_folder_in_use() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    let long = "train --dataset . --detector tiny.toml --epochs 100000 --out run";
    let mut first = program(dir.path(), long).stderr(std::process::Stdio::null()).spawn().unwrap();
    while !dir.path().join("run/metrics.jsonl").is_file() {
        assert!(first.try_wait().unwrap().is_none(), "the first run has ended");
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
    let output = run(dir.path(), long);
    first.kill().unwrap();
    first.wait().unwrap();
    assert_eq!(output.status.code(), Some(1));
    assert!(output_text(&output).contains("in use by another process"), "{}", output_text(&output));
}
