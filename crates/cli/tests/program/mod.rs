//! Runs the program, and writes a data set on which training takes seconds.

use data::write::write_split;
use data::{Cloud, Detection, Frame, Layout, Object, stream};
use geometry::Box3;
use rand::RngExt;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::Duration;

/// A PointPillars with a few thousand weights and a range of 10 m.
pub const TINY_DETECTOR: &str = r#"
name = "tiny"
classes = ["Car"]
channels = 4
range_m = [0.0, -5.12, -3.0, 10.24, 5.12, 1.0]
[network]
kind = "pointpillars"
vfe_filters = 8
[network.pillars]
size_m = [0.32, 0.32, 4.0]
max_points = 8
max_train = 1000
max_test = 1000
[network.backbone]
layers = [0, 1]
strides = [2, 2]
filters = [8, 16]
upsample_strides = [1, 2]
upsample_filters = [8, 8]
[[network.anchors]]
class = "Car"
size_m = [3.9, 1.6, 1.56]
bottom_m = -1.78
matched = 0.6
unmatched = 0.45
[optimization]
epochs = 3
batch_size = 2
"#;

/// A PointRCNN of similar size.
pub const TINY_POINTRCNN: &str = r#"
name = "tiny_pointrcnn"
classes = ["Car"]
channels = 4
range_m = [0.0, -5.12, -3.0, 10.24, 5.12, 1.0]
[network]
kind = "pointrcnn"
sampling = { points = 256 }
levels = [
    { centers = 64, scales = [{ radius_m = 0.5, samples = 8, filters = [8, 8] }] },
    { centers = 16, scales = [{ radius_m = 1.5, samples = 8, filters = [12, 16] }] },
]
propagation = [[16], [16]]
point_head = { mean_sizes = [{ class = "Car", size_m = [3.9, 1.6, 1.56] }], class_filters = [8, 8], box_filters = [8, 8] }
proposals = { train = { iou = 0.8, pre = 256, post = 32 }, test = { iou = 0.85, pre = 256, post = 16 } }
roi_sampling = { regions = 16 }
[network.roi_head]
points = 32
xyz_filters = [8, 8]
levels = [{ centers = 8, radius_m = 0.4, samples = 8, filters = [8, 8] }]
global_filters = [8, 16]
class_filters = [8, 8]
box_filters = [8, 8]
[optimization]
epochs = 3
batch_size = 2
"#;

/// A CenterPoint of similar size, with two layers of the pillar feature net.
pub const TINY_CENTERPOINT: &str = r#"
name = "tiny_centerpoint"
classes = ["Car"]
channels = 4
range_m = [0.0, -5.12, -3.0, 10.24, 5.12, 1.0]
[network]
kind = "centerpoint"
vfe_filters = [8, 8]
[network.pillars]
size_m = [0.32, 0.32, 4.0]
max_points = 8
max_train = 1000
max_test = 1000
[network.backbone]
layers = [0, 1]
strides = [2, 2]
filters = [8, 16]
upsample_strides = [1, 2]
upsample_filters = [8, 8]
[network.head]
filters = 8
[optimization]
epochs = 3
batch_size = 2
"#;

/// Writes seven frames with one or two cars on flat ground, in KITTI's layout with labels in the LiDAR frame, and the
/// detectors `tiny.toml`, `tiny_pointrcnn.toml` and `tiny_centerpoint.toml`.
pub fn data_set(folder: &Path) {
    let mut ids = Vec::new();
    for i in 0..7u64 {
        let mut random = stream(5, "scene", 0, i);
        let mut frame = Frame { id: format!("{i:06}"), cloud: Cloud::new(4), objects: Vec::new() };
        for _ in 0..600 {
            let at = [random.random_range(0.0..10.2), random.random_range(-5.1..5.1), -1.75];
            frame.cloud.values.extend(at.map(|v: f64| v as f32));
            frame.cloud.values.push(random.random());
        }
        for car in 0..1 + i % 2 {
            let bbox =
                Box3::from_array([3.0 + 4.5 * car as f64, random.random_range(-3.0..3.0), -1.0, 3.9, 1.6, 1.56, 0.1]);
            for _ in 0..80 {
                let local = [0, 1, 2].map(|k| random.random_range(-0.49..0.49) * bbox.size[k]);
                frame.cloud.values.extend(bbox.from_local(local).map(|v| v as f32));
                frame.cloud.values.push(random.random());
            }
            let class = "Car".into();
            frame.objects.push(Object { class, bbox, truncation: None, occlusion: None, image_box: None });
        }
        Layout::Kitti.write_frame(folder, &frame).unwrap();
        ids.push(frame.id);
    }
    write_split(&folder.join("ImageSets/train.txt"), &ids[..5]).unwrap();
    write_split(&folder.join("ImageSets/val.txt"), &ids[5..]).unwrap();
    std::fs::write(folder.join("tiny.toml"), TINY_DETECTOR).unwrap();
    std::fs::write(folder.join("tiny_pointrcnn.toml"), TINY_POINTRCNN).unwrap();
    std::fs::write(folder.join("tiny_centerpoint.toml"), TINY_CENTERPOINT).unwrap();
}

/// Writes `study.toml` beside the data set of [`data_set`]: one run of a network on it as `plain`, and one on a copy
/// with these effects as `changed`.
pub fn small_study(folder: &Path, effects: &str) {
    let study = r#"
name = "small"
about = ["A test."]
seeds = [1]
epochs = 1
splits = { test = "val" }
[[dataset]]
name = "plain"
source = { path = "." }
[[dataset]]
name = "changed"
source = { resim = { of = "plain", effects = "effects.toml" } }
[[detector]]
name = "tiny"
config = "tiny.toml"
"#;
    std::fs::write(folder.join("effects.toml"), effects).unwrap();
    std::fs::write(folder.join("study.toml"), study).unwrap();
}

/// A study of two data sets with the same frames, two seeds of the tiny network each.
pub const TWO_SETS_STUDY: &str = r#"
name = "tiny"
about = ["A test."]
seeds = [1, 2]
epochs = 2
splits = { test = "val" }

[[dataset]]
name = "plain"
title = "Plain"
source = { path = "." }

[[dataset]]
name = "noisy"
title = "Noisy"
source = { resim = { of = "plain", effects = "noise.toml" } }

[[detector]]
name = "tiny"
config = "tiny.toml"

[evaluation]
tsne = { perplexity = 1.0, steps = 50 }
distances = { emd_points = 32, sinkhorn_points = 32, sinkhorn_iterations = 5, directions = 4 }

[evaluation.matrix.bootstrap]
replicates = 40
"#;

/// The runs of [`TWO_SETS_STUDY`] below the folder of its detector.
pub const TWO_SETS_RUNS: [&str; 4] = ["plain/seed-1", "plain/seed-2", "noisy/seed-1", "noisy/seed-2"];

/// Writes `tiny-study.toml` with [`TWO_SETS_STUDY`] beside the data set of [`data_set`].
pub fn two_sets_study(folder: &Path) {
    data_set(folder);
    std::fs::write(folder.join("noise.toml"), "[[effect]]\nkind = \"range_noise\"\nstd_m = 0.05\n").unwrap();
    std::fs::write(folder.join("tiny-study.toml"), TWO_SETS_STUDY).unwrap();
}

/// OpenPCDet's `result.pkl` with these detections by frame, as Python writes arrays of numpy 2 with protocol 3.
pub fn result_pkl(frames: &[(String, Vec<Detection>)]) -> Vec<u8> {
    let text = |s: &str| [&b"X"[..], &(s.len() as u32).to_le_bytes(), s.as_bytes()].concat();
    let array = |kind: &str, shape: &[usize], size: i32, content: &[u8]| {
        let mut out = b"cnumpy._core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85C\x01b\x87R(K\x01(".to_vec();
        shape.iter().for_each(|n| out.extend([&b"J"[..], &(*n as i32).to_le_bytes()].concat()));
        out.extend(b"tcnumpy\ndtype\n");
        out.extend([text(kind), b"\x89\x88\x87R(K\x03".to_vec(), text("<"), b"NNN".to_vec()].concat());
        out.extend([&b"J"[..], &size.to_le_bytes(), b"J", &size.to_le_bytes(), b"K\x00tb\x89"].concat());
        out.extend([&b"B"[..], &(content.len() as u32).to_le_bytes(), content, b"tb"].concat());
        out
    };
    let mut out = b"\x80\x03](".to_vec();
    for (id, detections) in frames {
        let n = detections.len();
        let name = |d: &Detection| -> Vec<u8> {
            let mut codes: Vec<u32> = d.class.chars().map(u32::from).collect();
            codes.resize(10, 0);
            codes.iter().flat_map(|c| c.to_le_bytes()).collect()
        };
        let names: Vec<u8> = detections.iter().flat_map(name).collect();
        let scores: Vec<u8> = detections.iter().flat_map(|d| d.score.to_le_bytes()).collect();
        let boxes = |d: &Detection| d.bbox.to_array().map(|v| v as f32).into_iter().flat_map(f32::to_le_bytes);
        let boxes: Vec<u8> = detections.iter().flat_map(boxes).collect();
        out.extend([b"}(".to_vec(), text("frame_id"), text(id)].concat());
        out.extend([text("name"), array("U10", &[n], 40, &names)].concat());
        out.extend([text("score"), array("f4", &[n], -1, &scores)].concat());
        out.extend([text("boxes_lidar"), array("f4", &[n, 7], -1, &boxes), b"u".to_vec()].concat());
    }
    out.extend(b"e.");
    out
}

/// The program with these arguments and the working directory `folder`.
pub fn program(folder: &Path, arguments: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_lidarshift"));
    command.args(arguments.split_whitespace()).current_dir(folder);
    command
}

/// Runs the program and waits for its end.
pub fn run(folder: &Path, arguments: &str) -> Output {
    program(folder, arguments).output().expect("the program starts")
}

/// Runs the program, which must succeed.
pub fn must(folder: &Path, arguments: &str) -> Output {
    let output = run(folder, arguments);
    assert!(output.status.success(), "{arguments}: {}", output_text(&output));
    output
}

/// Stdout and stderr of the program.
pub fn output_text(output: &Output) -> String {
    format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
}

/// Number of lines in the metrics of a run.
pub fn steps(run: &Path) -> usize {
    std::fs::read_to_string(run.join("metrics.jsonl")).map_or(0, |text| text.lines().count())
}

/// Steps of all runs of [`two_sets_study`].
pub fn study_steps(folder: &Path) -> usize {
    TWO_SETS_RUNS.iter().map(|run| steps(&folder.join("runs/tiny/tiny").join(run))).sum()
}

/// Starts a command once for each patience, and kills it that long after `done` has grown. Two of them at least must
/// be killed before their end.
pub fn kill_repeatedly(command: impl Fn() -> Command, done: impl Fn() -> usize, patiences_ms: &[u64]) {
    let mut kills = 0;
    for &patience_ms in patiences_ms {
        let before = done();
        let mut child = command().stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        while done() == before && child.try_wait().unwrap().is_none() {
            std::thread::sleep(Duration::from_millis(2));
        }
        std::thread::sleep(Duration::from_millis(patience_ms));
        kills += u32::from(child.try_wait().unwrap().is_none());
        child.kill().unwrap(); // SIGKILL
        child.wait().unwrap();
    }
    assert!(kills >= 2, "only {kills} were killed before their end");
}

/// Whether `condition` comes true within ten minutes.
pub fn waits_for(mut condition: impl FnMut() -> bool) -> bool {
    (0..3000).any(|_| {
        std::thread::sleep(Duration::from_millis(200));
        condition()
    })
}

/// The output of a command of Slurm; `None` if it fails or does not exist.
pub fn slurm(arguments: &[&str]) -> Option<String> {
    let output = Command::new(arguments[0]).args(&arguments[1..]).output().ok()?;
    output.status.success().then(|| output_text(&output))
}

/// The number of the job of training that a submission names.
pub fn training_job(text: &str) -> String {
    text.lines().find_map(|line| line.strip_prefix("train: job ")?.split(',').next()).unwrap().to_string()
}
