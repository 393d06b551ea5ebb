//! Complete runs of a tiny network on synthetic frames.

use burn::tensor::Device;
use data::write::write_split;
use data::{Cloud, Frame, Layout, Object, stream};
use geometry::Box3;
use lidarshift_train::{
    Event, Provenance, RunConfig, Session, TrainError, Trained, TrainingFrames, samples, set_key, train,
};
use models::checkpoint::{NamedTensors, read_checkpoint, read_metadata};
use rand::RngExt;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

/// Seven frames of one or two cars on a flat ground; one has none.
fn data_set(folder: &Path) {
    let mut ids = Vec::new();
    for i in 0..7u64 {
        let mut random = stream(5, "scene", 0, i);
        let mut frame = Frame { id: format!("{i:06}"), cloud: Cloud::new(4), objects: Vec::new() };
        for _ in 0..600 {
            let at = [random.random_range(0.0..10.2), random.random_range(-5.1..5.1), -1.75];
            frame.cloud.values.extend(at.map(|v: f64| v as f32));
            frame.cloud.values.push(random.random());
        }
        for car in 0..i % 3 {
            let bbox =
                Box3::from_array([3.0 + 4.5 * car as f64, random.random_range(-3.0..3.0), -1.0, 3.9, 1.6, 1.56, 0.1]);
            for _ in 0..80 {
                let local = [0, 1, 2].map(|k| random.random_range(-0.49..0.49) * bbox.size[k]);
                frame.cloud.values.extend(bbox.from_local(local).map(|v| v as f32));
                frame.cloud.values.push(random.random());
            }
            frame.objects.push(Object {
                class: "Car".into(),
                bbox,
                truncation: None,
                occlusion: None,
                image_box: None,
            });
        }
        Layout::Kitti.write_frame(folder, &frame).unwrap();
        ids.push(frame.id);
    }
    write_split(&folder.join("ImageSets/train.txt"), &ids[..5]).unwrap();
    write_split(&folder.join("ImageSets/val.txt"), &ids[5..]).unwrap();
}

fn config(dataset: &Path, assignments: &[&str]) -> RunConfig {
    let mut table: toml::Table = r#"
        seed = 1
        dataset = ""
        [run]
        checkpoint_every_steps = 2
        log_every_steps = 2
        [detector]
        name = "tiny"
        classes = ["Car"]
        channels = 4
        range_m = [0.0, -5.12, -3.0, 10.24, 5.12, 1.0]
        [detector.network]
        kind = "pointpillars"
        vfe_filters = 8
        [detector.network.pillars]
        size_m = [0.32, 0.32, 4.0]
        max_points = 8
        max_train = 1000
        max_test = 1000
        [detector.network.backbone]
        layers = [0, 1]
        strides = [2, 2]
        filters = [8, 16]
        upsample_strides = [1, 2]
        upsample_filters = [8, 8]
        [[detector.network.anchors]]
        class = "Car"
        size_m = [3.9, 1.6, 1.56]
        bottom_m = -1.78
        matched = 0.6
        unmatched = 0.45
        [detector.optimization]
        epochs = 3
        batch_size = 2
    "#
    .parse()
    .unwrap();
    table["dataset"] = toml::Value::String(dataset.to_str().unwrap().into());
    for assignment in assignments {
        set_key(&mut table, assignment).unwrap();
    }
    RunConfig::from_table(table).unwrap()
}

/// The same run of a tiny PointRCNN.
fn pointrcnn(dataset: &Path, assignments: &[&str]) -> RunConfig {
    let mut table = config(dataset, assignments).to_table();
    let network = r#"
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
        [roi_head]
        points = 32
        xyz_filters = [8, 8]
        levels = [{ centers = 8, radius_m = 0.4, samples = 8, filters = [8, 8] }]
        global_filters = [8, 16]
        class_filters = [8, 8]
        box_filters = [8, 8]
    "#;
    table["detector"]["network"] = toml::Value::Table(network.parse().unwrap());
    RunConfig::from_table(table).unwrap()
}

fn session(workers: usize, resume: bool) -> Session {
    Session {
        device: Device::flex(),
        device_name: "flex".into(),
        workers,
        resume,
        allow_changed_data: false,
        cache: None,
        stop: None,
    }
}

fn run(config: &RunConfig, out: &Path, workers: usize, resume: bool) -> Result<Trained, TrainError> {
    train(config, out, &session(workers, resume), &mut |_| {})
}

#[test]
fn a_resumed_run_sees_the_same_frames() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    let config = config(dir.path(), &["augmentation.gt_sampling.enabled=false"]);
    let dataset = data::Dataset::open(dir.path()).unwrap();
    let frames = TrainingFrames::new(&config, &dataset, &dir.path().join("cache")).unwrap();
    let frames = std::sync::Arc::new(frames);
    let ids = |from: (u64, usize), workers: usize| -> Vec<String> {
        let all = samples(&frames, from, 4, workers, 3);
        all.map(|sample| sample.unwrap().id().to_string()).collect()
    };
    let whole = ids((0, 0), 2);
    assert_eq!(whole.len(), 4 * 5);
    for epoch in 0..4 {
        for position in 0..=5 {
            assert_eq!(ids((epoch, position), position % 3), whole[5 * epoch as usize + position..]);
        }
    }
    assert!(ids((4, 0), 1).is_empty());
}

fn weights(out: &Path) -> NamedTensors {
    read_checkpoint(&out.join("checkpoint/last.safetensors")).unwrap()
}

fn steps(out: &Path) -> Vec<(String, u64)> {
    let text = std::fs::read_to_string(out.join("metrics.jsonl")).unwrap();
    let line = |line: &str| {
        let value: serde_json::Value = serde_json::from_str(line).unwrap();
        (value["kind"].as_str().unwrap().to_string(), value["step"].as_u64().unwrap())
    };
    text.lines().map(line).collect()
}

#[test]
fn a_run_stopped_at_any_step_and_resumed_ends_with_the_same_bits() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    let config = config(dir.path(), &[]);
    let whole = dir.path().join("whole");
    let trained = run(&config, &whole, 1, false).unwrap();
    assert_eq!((trained.state.step, trained.state.total_steps, trained.state.epoch), (9, 9, 3));
    assert!(trained.validation.is_some());
    for stop in 1..9 {
        let out = dir.path().join(format!("stopped-{stop}"));
        let mut stopper = |event: Event| {
            if let Event::Step { metrics, .. } = event {
                assert!(metrics.step != stop, "stopped on purpose");
            }
        };
        catch_unwind(AssertUnwindSafe(|| train(&config, &out, &session(1, false), &mut stopper))).unwrap_err();
        let resumed = run(&config, &out, 1, true).unwrap();
        assert_eq!(weights(&whole), weights(&out), "stopped after step {stop}");
        assert_eq!(resumed.state, trained.state, "stopped after step {stop}");
        assert_eq!(steps(&whole), steps(&out), "stopped after step {stop}");
    }
    let again = run(&config, &whole, 1, true).unwrap();
    assert_eq!(again.state, trained.state);
}

#[test]
fn pointrcnn_resumes_bit_equal_for_any_number_of_workers() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    let config = pointrcnn(dir.path(), &[]);
    let whole = dir.path().join("whole");
    let trained = run(&config, &whole, 1, false).unwrap();
    assert!(trained.validation.is_some_and(|v| v.loss.is_finite()));
    for (stop, workers) in [(1, 4), (4, 1), (6, 2)] {
        let out = dir.path().join(format!("stopped-{stop}"));
        let mut stopper = |event: Event| {
            if let Event::Step { metrics, .. } = event {
                assert!(metrics.step != stop, "stopped on purpose");
            }
        };
        let session = session(workers, false);
        catch_unwind(AssertUnwindSafe(|| train(&config, &out, &session, &mut stopper))).unwrap_err();
        let resumed = run(&config, &out, 2, true).unwrap();
        assert_eq!(weights(&whole), weights(&out), "stopped after step {stop}");
        assert_eq!(resumed.state, trained.state, "stopped after step {stop}");
    }
    let other = dir.path().join("other");
    run(&pointrcnn(dir.path(), &["seed=2"]), &other, 1, false).unwrap();
    assert_ne!(weights(&whole), weights(&other));
}

#[test]
fn workers_do_not_change_weights_but_seeds_do() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    let [one, four, other] = ["one", "four", "other"].map(|name| dir.path().join(name));
    run(&config(dir.path(), &[]), &one, 1, false).unwrap();
    run(&config(dir.path(), &[]), &four, 4, false).unwrap();
    run(&config(dir.path(), &["seed=2"]), &other, 4, false).unwrap();
    assert_eq!(weights(&one), weights(&four));
    let (ours, others) = (weights(&one), weights(&other));
    assert!(ours.iter().filter(|(name, _)| name.ends_with("weight")).all(|(name, tensor)| others[name] != *tensor));
}

#[test]
fn the_folder_records_provenance_and_metadata() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    let config = config(dir.path(), &["overfit=true", "run.evaluate_every_epochs=2"]);
    let out = dir.path().join("run");
    let trained = run(&config, &out, 2, false).unwrap();
    assert_eq!(trained.state.total_steps, 3 * 4, "all seven frames, two a step");
    assert_eq!(RunConfig::read(&out.join("config.toml")).unwrap(), config);
    let provenance: Provenance = serde_json::from_slice(&std::fs::read(out.join("provenance.json")).unwrap()).unwrap();
    assert_eq!((provenance.dataset.frames, provenance.sessions.len()), (7, 1));
    let metadata = read_metadata(&out.join("checkpoint/last.safetensors")).unwrap();
    let detector = models::config::DetectorConfig::parse(&metadata["detector"]).unwrap();
    assert_eq!((detector, metadata["step"].as_str()), (config.detector, "12"));
    let epochs: Vec<u64> = steps(&out).into_iter().filter(|(kind, _)| kind == "epoch").map(|(_, step)| step).collect();
    assert_eq!(epochs, [4, 8, 12]);
}

#[test]
fn initial_weights_are_loaded_and_must_fit_the_network() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    let first = dir.path().join("first");
    run(&config(dir.path(), &["optimization.epochs=1"]), &first, 1, false).unwrap();
    let init = format!("init={}", first.join("checkpoint/last.safetensors").display());
    // A learning rate of almost zero does not change them.
    let same = config(dir.path(), &[&init, "optimization.epochs=1", "optimization.lr_max=1e-30"]);
    run(&same, &dir.path().join("same"), 1, false).unwrap();
    assert_eq!(
        weights(&first)["dense_head.conv_cls.weight"],
        weights(&dir.path().join("same"))["dense_head.conv_cls.weight"]
    );
    let wider = config(dir.path(), &[&init, "network.vfe_filters=16"]);
    let message = run(&wider, &dir.path().join("wider"), 1, false).unwrap_err().to_string();
    assert!(message.contains("last.safetensors") && message.contains("another network"), "{message}");
}

#[test]
fn changed_settings_or_frames_are_not_resumed() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    let out = dir.path().join("run");
    run(&config(dir.path(), &[]), &out, 1, false).unwrap();
    let message = run(&config(dir.path(), &[]), &out, 1, false).unwrap_err().to_string();
    assert!(message.contains("add --resume"), "{message}");
    let message = run(&config(dir.path(), &["optimization.epochs=4"]), &out, 1, true).unwrap_err().to_string();
    assert!(message.contains("detector.optimization.epochs is 3, not 4"), "{message}");
    write_split(&dir.path().join("ImageSets/train.txt"), &["000001", "000002"]).unwrap();
    let message = run(&config(dir.path(), &[]), &out, 1, true).unwrap_err().to_string();
    assert!(message.contains("other training frames"), "{message}");
}

#[test]
fn a_value_that_is_not_finite_stops_the_run() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    let config = config(dir.path(), &["optimization.lr_max=1e30"]);
    let message = run(&config, &dir.path().join("run"), 1, false).unwrap_err().to_string();
    assert!(message.contains("is not finite") && message.contains("frames 0000"), "{message}");
}

#[test]
fn data_sets_that_do_not_fit_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    let refused = |assignments: &[&str], want: &str| {
        let out = dir.path().join("run");
        let message = run(&config(dir.path(), assignments), &out, 1, false).unwrap_err().to_string();
        assert!(message.contains(want), "{assignments:?}: {message}");
        assert!(!out.join("config.toml").exists());
    };
    let pedestrian =
        r#"network.anchors=[{class="Pedestrian",size_m=[0.8,0.6,1.7],bottom_m=-0.6,matched=0.5,unmatched=0.35}]"#;
    refused(&["classes=[\"Pedestrian\"]", pedestrian], "the data set has the classes Car");
    refused(&["run.train_split=night"], "no split \"night\"");
    write_split(&dir.path().join("ImageSets/train.txt"), &["000000", "000003"]).unwrap();
    let out = dir.path().join("nothing");
    let message = run(&config(dir.path(), &[]), &out, 1, false).unwrap_err().to_string();
    assert!(message.contains("nothing to learn"), "{message}");
}

#[test]
fn frames_without_points_in_range_are_accepted() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    for id in ["000001", "000006"] {
        let far = Cloud { values: vec![90.0, 0.0, 0.0, 0.5], channels: 4 };
        data::write::write_bin(&dir.path().join(format!("velodyne/{id}.bin")), &far).unwrap();
    }
    let config = config(dir.path(), &["optimization.batch_size=1", "optimization.epochs=1"]);
    run(&config, &dir.path().join("run"), 1, false).unwrap();
}
