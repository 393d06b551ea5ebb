//! Data sets in an object store, through a program that was built with the feature `store`: trainings and a study,
//! killed and resumed, equal to those of the same data set on the disk.
#![cfg(feature = "store")]

#[path = "../../data/tests/bucket/mod.rs"]
#[allow(dead_code, reason = "each test file uses a part of it")]
mod bucket;
#[allow(dead_code, reason = "each test file uses a part of it")]
mod program;

use bucket::Server;
use program::{data_set, must, output_text, program};
use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

/// The data set in the bucket.
const URL: &str = "s3://drives/set";

/// A folder with the data set in shards of two frames, and a server that has the same.
fn prepared(folder: &Path) -> (Arc<Server>, String) {
    data_set(folder);
    must(folder, "convert . --to shards --shard-frames 2 --out shards");
    let (server, address) = Server::start();
    server.put_folder(&folder.join("shards"), "set");
    (server, address)
}

/// The program with access to the server.
fn with_store(folder: &Path, address: &str, arguments: &str) -> Command {
    let mut command = program(folder, arguments);
    command.env("AWS_ACCESS_KEY_ID", "key").env("AWS_SECRET_ACCESS_KEY", "secret").env("AWS_ENDPOINT_URL", address);
    command
}

fn finish(mut command: Command) -> String {
    let output = command.output().unwrap();
    assert!(output.status.success(), "{command:?}: {}", output_text(&output));
    output_text(&output)
}

/// Kills the command some times, each time when `done` has grown, and lets it end then.
fn kill_and_finish(command: &dyn Fn() -> Command, done: &dyn Fn() -> usize, server: &Server) {
    let mut kills = 0;
    for patience_ms in [0, 20, 60, 150] {
        let before = done();
        // Some requests fail for a while.
        server.busy.store(2, Relaxed);
        server.cut.store(1, Relaxed);
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
    finish(command());
}

fn lines(path: &Path) -> usize {
    fs::read_to_string(path).map_or(0, |text| text.lines().count())
}

#[test]
fn a_killed_training_from_a_store_ends_with_the_bits_of_a_local_one() {
    let dir = tempfile::tempdir().unwrap();
    let (server, address) = prepared(dir.path());
    let train = |dataset: &str, out: &str| {
        let settings = "--detector tiny.toml --epochs 4 --seed 1 --set run.checkpoint_every_steps=2";
        format!("train --dataset {dataset} {settings} --out {out} --resume")
    };
    must(dir.path(), &train("shards", "local"));
    let command = || with_store(dir.path(), &address, &train(URL, "remote"));
    kill_and_finish(&command, &|| lines(&dir.path().join("remote/metrics.jsonl")), &server);
    let weights = |out: &str| fs::read(dir.path().join(out).join("checkpoint/last.safetensors")).unwrap();
    assert!(weights("remote") == weights("local"), "the weights differ");
    let report = finish(with_store(dir.path(), &address, &format!("doctor {URL}")));
    assert!(report.contains('7'), "{report}");

    let output = program(dir.path(), &train(URL, "other")).env_remove("AWS_ACCESS_KEY_ID").output().unwrap();
    let text = output_text(&output);
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert!(text.contains("s3://drives/set: needs credentials: set AWS_ACCESS_KEY_ID"), "{text}");
}

/// The data set and a changed copy, two seeds.
const STUDY: &str = r#"
name = "tiny"
about = ["A test."]
seeds = [1, 2]
epochs = 2
splits = { test = "val" }
[[dataset]]
name = "plain"
source = { path = "SET" }
[[dataset]]
name = "noisy"
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

#[test]
fn a_killed_study_with_a_data_set_in_a_store_gives_the_numbers_of_a_local_one() {
    let dir = tempfile::tempdir().unwrap();
    let (server, address) = prepared(dir.path());
    fs::write(dir.path().join("noise.toml"), "[[effect]]\nkind = \"range_noise\"\nstd_m = 0.05\n").unwrap();
    for (name, set) in [("local", "shards"), ("remote", URL)] {
        let text = STUDY.replace("SET", set).replace("name = \"tiny\"\nabout", &format!("name = \"{name}\"\nabout"));
        fs::write(dir.path().join(format!("{name}.toml")), text).unwrap();
    }
    must(dir.path(), "study local.toml");
    let runs = ["plain/seed-1", "plain/seed-2", "noisy/seed-1", "noisy/seed-2"];
    let run = |study: &str, run: &str| dir.path().join("runs").join(study).join("tiny").join(run);
    let done = || runs.iter().map(|name| lines(&run("remote", name).join("metrics.jsonl"))).sum();
    kill_and_finish(&|| with_store(dir.path(), &address, "study remote.toml"), &done, &server);
    for name in runs {
        for file in ["checkpoint/last.safetensors", "detections/plain/detections.parquet"] {
            let bytes = |study: &str| fs::read(run(study, name).join(file)).unwrap();
            assert!(bytes("remote") == bytes("local"), "{name}/{file} differs");
        }
    }
    let matrix = |study: &str| -> serde_json::Value {
        serde_json::from_slice(&fs::read(dir.path().join("runs").join(study).join("matrix.json")).unwrap()).unwrap()
    };
    assert_eq!(matrix("remote"), matrix("local"));
    let status = finish(with_store(dir.path(), &address, "study status remote.toml"));
    assert!(status.contains("4 done"), "{status}");
}
