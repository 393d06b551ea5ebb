//! `lidarshift twin` on recordings in which something is wrong: what is put right and said, and what is refused.

mod forms;
#[allow(dead_code, reason = "each test file uses a part of it")]
mod program;
#[path = "../../twin/tests/room/mod.rs"]
#[allow(dead_code, reason = "each test file uses a part of it")]
mod room;
#[path = "../../twin/tests/street/mod.rs"]
mod street;

use program::{must, output_text, run};
use room::write_recording;
use std::fs;
use std::path::Path;
use street::{Hit, write_street};

/// A matrix of 3 rows and 4 columns.
type Pose = [[f64; 4]; 3];

const FRAMES: usize = 8;

/// The recording in `DIR/drive`: 1 m and 3 degrees a frame.
fn drive(folder: &Path) {
    write_recording(&folder.join("drive"), FRAMES, 1.0, 0.05);
}

fn edit(folder: &Path, name: &str, change: impl Fn(usize, &str) -> String) {
    let path = folder.join("drive").join(name);
    let lines: Vec<String> =
        fs::read_to_string(&path).unwrap().lines().enumerate().map(|(i, l)| change(i, l)).collect();
    fs::write(path, lines.join("\n")).unwrap();
}

fn pose(line: &str) -> Pose {
    let values: Vec<f64> = line.split(' ').map(|word| word.parse().unwrap()).collect();
    [0, 1, 2].map(|row| [0, 1, 2, 3].map(|column: usize| values[4 * row + column]))
}

fn line(pose: &Pose) -> String {
    pose.as_flattened().iter().map(f64::to_string).collect::<Vec<_>>().join(" ")
}

/// The product of two poses.
fn times(a: &Pose, b: &Pose) -> Pose {
    let sum = |r: usize, c: usize| (0..3).map(|k| a[r][k] * b[k][c]).sum::<f64>() + if c == 3 { a[r][3] } else { 0.0 };
    [0, 1, 2].map(|r| [0, 1, 2, 3].map(|c| sum(r, c)))
}

fn inverse(pose: &Pose) -> Pose {
    let back = |r: usize| -(0..3).map(|k| pose[k][r] * pose[k][3]).sum::<f64>();
    [0, 1, 2].map(|r| [pose[0][r], pose[1][r], pose[2][r], back(r)])
}

/// The axes of a camera: x right, y down, z forward.
const LIDAR_FROM_CAMERA: Pose = [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0]];

fn camera(given: &Pose) -> Pose {
    times(&times(&inverse(&LIDAR_FROM_CAMERA), given), &LIDAR_FROM_CAMERA)
}

/// y to the other side, in both frames.
fn mirrored(given: &Pose) -> Pose {
    [0, 1, 2].map(|r| [0, 1, 2, 3].map(|c| if (r == 1) == (c == 1) { given[r][c] } else { -given[r][c] }))
}

/// The angle of yaw as if its radians were degrees.
fn degrees(given: &Pose) -> Pose {
    let yaw = given[1][0].atan2(given[0][0]).to_radians();
    let (sin, cos) = yaw.sin_cos();
    [[cos, -sin, 0.0, given[0][3]], [sin, cos, 0.0, given[1][3]], given[2]]
}

#[test]
fn poses_of_another_convention_are_found_and_said() {
    type Change = fn(&Pose) -> Pose;
    let cases: [(Change, &str); 5] = [
        (inverse, "inverse (world to LiDAR)"),
        (camera, "camera axes (x right, y down, z forward)"),
        (|p| inverse(&camera(p)), "inverse, camera axes"),
        (mirrored, "other handedness (y to the other side)"),
        (degrees, "angles in rad that were taken as degrees"),
    ];
    for (change, want) in cases {
        let folder = tempfile::tempdir().unwrap();
        drive(folder.path());
        edit(folder.path(), "poses.txt", |_, l| line(&change(&pose(l))));
        let text = output_text(&must(folder.path(), "twin drive --out out"));
        assert!(text.contains("the poses fit another convention, ") && text.contains(want), "{want}: {text}");
        assert!(text.contains("the twin is made with converted poses"), "{text}");
        let report = fs::read_to_string(folder.path().join("out/twin.json")).unwrap();
        let report: serde_json::Value = serde_json::from_str(&report).unwrap();
        let median = report["static_world"]["median_abs_m"].as_f64().unwrap();
        assert!(median < 0.02, "{want}: {median}");
        // Poses that are to be kept are kept, and it is said that they do not fit.
        let text = output_text(&must(folder.path(), "twin drive --out kept --keep-poses"));
        assert!(text.contains("they are kept as they are"), "{text}");
    }
}

#[test]
fn what_is_wrong_with_frames_and_stamps_is_put_right_and_said() {
    let stamps = |folder: &Path, of: fn(usize) -> String| {
        fs::write(folder.join("drive/times.txt"), (0..FRAMES).map(of).collect::<Vec<_>>().join("\n")).unwrap();
    };
    let folder = tempfile::tempdir().unwrap();
    drive(folder.path());
    stamps(folder.path(), |i| format!("{:.1}", 0.1 * i as f64));
    must(folder.path(), "twin drive --out seconds");
    let shots = |out: &str| fs::read(folder.path().join(out).join("sim/velodyne/000004.bin")).unwrap();
    for (unit, of) in
        [("ms", (|i| format!("{}", 100 * i)) as fn(usize) -> String), ("ns", |i| format!("{}", 100_000_000 * i))]
    {
        stamps(folder.path(), of);
        must(folder.path(), &format!("twin drive --out {unit}"));
        assert!(shots(unit) == shots("seconds"), "{unit}");
    }
    type Stamps = fn(usize) -> f64;
    let cases: [(&str, Stamps, &str); 3] = [
        ("order", |i| [0.0, 0.1, 0.2, 0.4, 0.3, 0.5, 0.6, 0.7][i], "frames are not in the order of their time stamps"),
        ("twice", |i| [0.0, 0.1, 0.2, 0.3, 0.3, 0.5, 0.6, 0.7][i], "and 1 that have the time stamp of another"),
        ("missing", |i| 0.1 * (i + if i > 4 { 7 } else { 0 }) as f64, "s without a frame"),
    ];
    for (name, of, want) in cases {
        let text: Vec<String> = (0..FRAMES).map(|i| of(i).to_string()).collect();
        fs::write(folder.path().join("drive/times.txt"), text.join("\n")).unwrap();
        let text = output_text(&must(folder.path(), &format!("twin drive --out {name}")));
        assert!(text.contains(want), "{name}: {text}");
    }
}

#[test]
fn gaps_missing_labels_and_a_standing_car_are_said() {
    let folder = tempfile::tempdir().unwrap();
    drive(folder.path());
    edit(folder.path(), "poses.txt", |i, l| if i == 3 || i == 4 { ["nan"; 12].join(" ") } else { l.into() });
    let text = output_text(&must(folder.path(), "twin drive --out gap"));
    assert!(
        text.contains("2 frames from 000003 to 000004 have no pose") && text.contains("they are left out"),
        "{text}"
    );
    assert!(text.contains("6 frames; poses of the recording"), "{text}");
    let text = output_text(&must(folder.path(), "twin drive --out odometry --odometry"));
    assert!(text.contains("8 frames; poses by aligning the scans"), "{text}");
    let found = forms::check_files(&folder.path().join("odometry"), &[]);
    assert!(["twin", "twin-dataset"].iter().all(|form| found.contains(*form)), "{found:?}");
    fs::remove_file(folder.path().join("drive/poses.txt")).unwrap();
    let text = output_text(&must(folder.path(), "twin drive --out without"));
    assert!(text.contains("8 frames; poses by aligning the scans"), "{text}");
    fs::remove_dir_all(folder.path().join("drive")).unwrap();
    write_recording(&folder.path().join("drive"), FRAMES, 0.0, 0.0);
    fs::remove_file(folder.path().join("drive/labels.csv")).unwrap();
    let text = output_text(&must(folder.path(), "twin drive --out standing"));
    assert!(text.contains("the vehicle stays within 0.00 m") && text.contains("there are no tracked boxes"), "{text}");
}

#[test]
fn what_cannot_be_put_right_is_refused_with_what_to_do() {
    type Fault = fn(&Path);
    let cases: [(Fault, &str, &[&str]); 5] = [
        (
            |folder| edit(folder, "poses.txt", |i, l| if i == 2 { l.replacen("0 ", "nan ", 1) } else { l.into() }),
            "",
            &["poses.txt:3: ", "a pose that is not known has nan in all values"],
        ),
        (
            |folder| edit(folder, "poses.txt", |i, l| if i > 0 { ["nan"; 12].join(" ") } else { l.into() }),
            "",
            &["drive: 1 frames", "have no pose", "--odometry finds poses for all frames"],
        ),
        (|_| (), "--frames 1", &["drive: 1 frames; a twin is made of at least 2"]),
        (|_| (), "--memory 1", &["the map of 4 frames from 000001 to 000007 needs more than", "give --memory MIB"]),
        (
            // One place again and again, with poses that claim a drive.
            |folder| {
                let first = fs::read(folder.join("drive/velodyne/000000.bin")).unwrap();
                (0..FRAMES).for_each(|i| fs::write(folder.join(format!("drive/velodyne/{i:06}.bin")), &first).unwrap());
            },
            "",
            &["the poses fit no known convention", "--odometry"],
        ),
    ];
    for (fault, options, want) in cases {
        let folder = tempfile::tempdir().unwrap();
        drive(folder.path());
        fault(folder.path());
        let output = run(folder.path(), &format!("twin drive --out out {options}"));
        let text = output_text(&output);
        assert!(!output.status.success(), "{want:?}: {text}");
        assert!(want.iter().all(|want| text.contains(want)), "{want:?}: {text}");
    }
}

/// What a sensor makes of a shot.
type Sensor = fn(&Hit) -> Option<f64>;

/// Faults of a sensor with 1 cm of noise: name, sensor, and the causes that a diagnosis of its twin may name.
const FAULTS: [(&str, Sensor, &[&str]); 8] = [
    ("none", |h| Some(h.range_m + 0.01 * h.normal(0)), &[]),
    ("range_bias", |h| Some(h.range_m + 0.15 + 0.01 * h.normal(0)), &[]),
    ("range_noise", |h| Some(h.range_m + 0.05 * h.normal(0)), &[]),
    (
        "beam_range_offset",
        |h| Some(h.range_m + [0.05, -0.05, 0.03, -0.03][h.row % 4] + 0.01 * h.normal(0)),
        &["beam_range_offset"],
    ),
    (
        "random_dropout",
        |h| (h.uniform(9) > 0.1).then(|| h.range_m + 0.01 * h.normal(0)),
        &["random_dropout", "range_dropout", "incidence_dropout", "signal_dropout"],
    ),
    (
        "range_dropout",
        |h| (h.uniform(9) > (h.range_m / 70.0).powi(2)).then(|| h.range_m + 0.01 * h.normal(0)),
        &["range_dropout", "incidence_dropout", "signal_dropout"],
    ),
    ("quantisation", |h| Some(((h.range_m + 0.01 * h.normal(0)) / 0.1).round() * 0.1), &["quantisation"]),
    (
        "outliers",
        |h| {
            Some(if h.uniform(9) < 0.02 {
                2.0 + h.uniform(8) * (h.range_m - 2.0)
            } else {
                h.range_m + 0.01 * h.normal(0)
            })
        },
        &["outliers"],
    ),
];

/// Runs the program on a street with a fault, and returns status, cause or candidates of each finding.
fn findings(sensor: Sensor, frames: usize) -> Vec<(String, Vec<String>)> {
    let folder = tempfile::tempdir().unwrap();
    write_street(&folder.path().join("drive"), frames, &sensor);
    must(folder.path(), "twin drive --out twin");
    must(folder.path(), "diagnose --measured twin/measured --simulated twin/sim --out found");
    let text = fs::read_to_string(folder.path().join("found/diagnosis.json")).unwrap();
    let diagnosis: serde_json::Value = serde_json::from_str(&text).unwrap();
    let word = |v: &serde_json::Value| v.as_str().unwrap_or_default().to_string();
    let of = |f: &serde_json::Value| {
        let causes =
            f["candidates"].as_array().map(|c| c.iter().map(word).collect()).unwrap_or(vec![word(&f["cause"])]);
        eprintln!("  {} {causes:?}: {}", f["status"], f["says"]);
        (word(&f["status"]), causes)
    };
    diagnosis["findings"].as_array().unwrap().iter().map(of).collect()
}

/// The table of the book: `cargo test -p lidarshift --test twin -- --ignored --nocapture`.
#[test]
#[ignore = "takes minutes: all faults"]
fn no_fault_has_a_false_name_on_a_twin() {
    for (name, sensor, known) in FAULTS {
        eprintln!("{name}");
        check(name, &findings(sensor, 36), known);
    }
}

/// Named causes are those of the fault.
fn check(name: &str, findings: &[(String, Vec<String>)], known: &[&str]) {
    for (status, causes) in findings.iter().filter(|(status, _)| status == "named" || status == "ambiguous") {
        let right = causes.iter().any(|cause| known.contains(&cause.as_str()));
        assert!(right, "{name}: {status} {causes:?}");
    }
}

#[test]
fn noise_is_not_identifiable_and_offsets_of_rows_are_found() {
    for (name, sensor, known) in FAULTS.iter().filter(|f| ["range_noise", "beam_range_offset"].contains(&f.0)) {
        let found = findings(*sensor, 24);
        check(name, &found, known);
        let status = |cause: &str| found.iter().find(|f| f.1.iter().any(|c| c == cause)).map(|f| f.0.as_str());
        match *name {
            "range_noise" => assert_eq!(status("range_noise"), Some("not_identifiable"), "{found:?}"),
            _ => assert_eq!(status("beam_range_offset"), Some("named"), "{found:?}"),
        }
    }
}
