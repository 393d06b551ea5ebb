//! One training run through the program: killed and resumed, with different numbers of threads, with equal and
//! different seeds.

#[allow(dead_code, reason = "each test file uses a part of it")]
mod program;

use program::{data_set, kill_repeatedly, must, output_text, program, steps};
use std::fs;
use std::path::Path;

const TRAIN: &str = "train --dataset . --detector tiny.toml --epochs 4 --set run.checkpoint_every_steps=2";
const TRAIN_POINTRCNN: &str =
    "train --dataset . --detector tiny_pointrcnn.toml --epochs 4 --set run.checkpoint_every_steps=2";

const TRAIN_CENTERPOINT: &str =
    "train --dataset . --detector tiny_centerpoint.toml --epochs 4 --set run.checkpoint_every_steps=2";

fn weights(folder: &Path, run: &str) -> Vec<u8> {
    fs::read(folder.join(run).join("checkpoint/last.safetensors")).unwrap()
}

#[test]
fn killed_at_any_moment_and_resumed_ends_with_the_same_bits() {
    kill_and_resume(TRAIN);
}

#[test]
fn pointrcnn_killed_at_any_moment_and_resumed_ends_with_the_same_bits() {
    kill_and_resume(TRAIN_POINTRCNN);
}

#[test]
fn centerpoint_killed_at_any_moment_and_resumed_ends_with_the_same_bits() {
    kill_and_resume(TRAIN_CENTERPOINT);
}

fn kill_and_resume(train: &str) {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    must(dir.path(), &format!("{train} --seed 1 --out whole"));
    let command = || program(dir.path(), &format!("{train} --seed 1 --out killed --resume"));
    kill_repeatedly(command, || steps(&dir.path().join("killed")), &[0, 15, 40, 90, 150, 300]);
    must(dir.path(), &format!("{train} --seed 1 --out killed --resume"));
    assert!(weights(dir.path(), "killed") == weights(dir.path(), "whole"), "the weights differ");
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    let networks = [(TRAIN, "pointpillars"), (TRAIN_POINTRCNN, "pointrcnn"), (TRAIN_CENTERPOINT, "centerpoint")];
    for (train, network) in networks {
        let [one, two, three] = ["1", "2", "3"].map(|threads| {
            let out = format!("{network}-{threads}");
            let mut child = program(dir.path(), &format!("{train} --out {out}"));
            let output = child.env("RAYON_NUM_THREADS", threads).output().unwrap();
            assert!(output.status.success(), "{}", output_text(&output));
            weights(dir.path(), &out)
        });
        assert!(one == two && two == three, "{network}: the weights depend on the number of threads");
    }
}

#[test]
fn workers_and_repetition_change_no_bit_and_the_seed_does() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    for (seed, workers, out) in [(1, 1, "a"), (1, 4, "b"), (1, 1, "c"), (2, 1, "d")] {
        must(dir.path(), &format!("{TRAIN} --seed {seed} --workers {workers} --out {out}"));
    }
    let [a, b, c, d] = ["a", "b", "c", "d"].map(|run| weights(dir.path(), run));
    assert!(a == b, "four workers give other weights than one");
    assert!(a == c, "a second run gives other weights");
    assert!(a != d, "two seeds give the same weights");
}

#[test]
fn a_split_is_detected_and_evaluated_from_kitti_text() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    must(dir.path(), &format!("{TRAIN} --out run"));
    must(dir.path(), "detect . --split val --checkpoint run/checkpoint/last.safetensors --out found");
    for id in ["000005", "000006"] {
        assert!(dir.path().join(format!("found/{id}.txt")).is_file());
    }
    must(
        dir.path(),
        "eval ap --labels label_2 --label-frame lidar --detections found --ids ImageSets/val.txt --json ap.json",
    );
    let ap: serde_json::Value = serde_json::from_slice(&fs::read(dir.path().join("ap.json")).unwrap()).unwrap();
    let rows = ap["rows"].as_array().unwrap();
    let all = rows.iter().find(|r| r["metric"] == "3d" && r["difficulty"] == "all").unwrap();
    assert_eq!(all["n_gt"], 3);
    let output = must(
        dir.path(),
        "detect velodyne/000005.bin --checkpoint run/checkpoint/last.safetensors --labels label_2/000005.txt --json boxes.json",
    );
    let boxes: serde_json::Value = serde_json::from_slice(&fs::read(dir.path().join("boxes.json")).unwrap()).unwrap();
    assert_eq!(
        boxes["detections"].as_array().unwrap().len(),
        String::from_utf8(output.stdout).unwrap().lines().count()
    );
    assert!(fs::read(dir.path().join("000005.png")).unwrap().starts_with(b"\x89PNG"));
}

#[test]
fn the_smoke_run_writes_all_results() {
    let dir = tempfile::tempdir().unwrap();
    let output = must(dir.path(), "train --smoke --out smoke");
    assert!(String::from_utf8_lossy(&output.stdout).contains("run folder"), "{}", program::output_text(&output));
    for file in ["checkpoint/last.safetensors", "eval.json", "curve.svg", "config.toml", "provenance.json"] {
        assert!(dir.path().join("smoke/seed-0").join(file).is_file(), "{file}");
    }
}
