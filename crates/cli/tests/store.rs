//! Data sets in an object store, through a program that was built with the feature `store`: trainings and studies,
//! killed and resumed, on this machine and on Slurm, equal to those of the same data set on the disk.
#![cfg(feature = "store")]

#[path = "../../data/tests/bucket/mod.rs"]
#[allow(dead_code, reason = "each test file uses a part of it")]
mod bucket;
#[allow(dead_code, reason = "each test file uses a part of it")]
mod program;

use bucket::Server;
use program::{
    TWO_SETS_RUNS, TWO_SETS_STUDY, data_set, kill_repeatedly, must, output_text, program, slurm, steps, study_steps,
    training_job, two_sets_study, waits_for,
};
use std::fs;
use std::path::Path;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;

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

/// Kills the command some times, and lets it end then.
fn kill_and_finish(command: impl Fn() -> Command, done: impl Fn() -> usize, server: &Server) {
    let failing = || {
        // Some requests fail for a while.
        server.busy.store(2, Relaxed);
        server.cut.store(1, Relaxed);
        command()
    };
    kill_repeatedly(failing, done, &[0, 20, 60, 150]);
    finish(command());
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
    kill_and_finish(command, || steps(&dir.path().join("remote")), &server);
    let weights = |out: &str| fs::read(dir.path().join(out).join("checkpoint/last.safetensors")).unwrap();
    assert!(weights("remote") == weights("local"), "the weights differ");
    let report = finish(with_store(dir.path(), &address, &format!("doctor {URL}")));
    assert!(report.contains('7'), "{report}");

    let output = program(dir.path(), &train(URL, "other")).env_remove("AWS_ACCESS_KEY_ID").output().unwrap();
    let text = output_text(&output);
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert!(text.contains("s3://drives/set: needs credentials: set AWS_ACCESS_KEY_ID"), "{text}");
}

/// What has to be equal: weights and detections of each run, and the matrix.
fn assert_same_study(folder: &Path, wanted: &Path) {
    let files = TWO_SETS_RUNS.iter().flat_map(|run| {
        ["checkpoint/last.safetensors", "detections/plain/detections.parquet", "detections/noisy/detections.parquet"]
            .map(|file| format!("tiny/{run}/{file}"))
    });
    for file in files.chain(["matrix.json".into()]) {
        let bytes = |root: &Path| fs::read(root.join("runs/tiny").join(&file)).unwrap();
        assert!(bytes(folder) == bytes(wanted), "{file} differs");
    }
}

/// Two folders with the study: of the data set on the disk, where it is done, and of that in the store.
fn studies(study: &str) -> (tempfile::TempDir, tempfile::TempDir, Arc<Server>, String) {
    let [local, remote] = [(), ()].map(|()| tempfile::tempdir().unwrap());
    let (server, address) = prepared(local.path());
    for (folder, set) in [(&local, "shards"), (&remote, URL)] {
        two_sets_study(folder.path());
        let text = study.replace("path = \".\"", &format!("path = \"{set}\""));
        fs::write(folder.path().join("tiny-study.toml"), text).unwrap();
    }
    must(local.path(), "study tiny-study.toml");
    (local, remote, server, address)
}

#[test]
fn a_killed_study_with_a_data_set_in_a_store_gives_the_numbers_of_a_local_one() {
    let (local, remote, server, address) = studies(TWO_SETS_STUDY);
    let command = || with_store(remote.path(), &address, "study tiny-study.toml");
    kill_and_finish(command, || study_steps(remote.path()), &server);
    assert_same_study(remote.path(), local.path());
    let status = finish(with_store(remote.path(), &address, "study status tiny-study.toml"));
    assert!(status.contains("4 done"), "{status}");
}

#[test]
fn on_slurm_a_requeued_study_with_a_data_set_in_a_store_gives_the_numbers_of_a_local_one() {
    if slurm(&["sinfo", "--noheader"]).is_none() {
        eprintln!("skipped: there is no Slurm");
        return;
    }
    let (local, remote, _server, address) = studies(&TWO_SETS_STUDY.replace("epochs = 2", "epochs = 40"));
    let submit = || finish(with_store(remote.path(), &address, "study tiny-study.toml --launcher slurm"));
    let run = |index: usize| remote.path().join("runs/tiny/tiny").join(TWO_SETS_RUNS[index]);
    let job = training_job(&submit());
    // As at a pre-emption: SIGTERM, then the same task once more. Another task is killed and not repeated.
    assert!(waits_for(|| steps(&run(0)) > 0), "the first task does not begin");
    slurm(&["scontrol", "requeue", &format!("{job}_0")]).expect("a task that is at work");
    slurm(&["scancel", &format!("{job}_3")]).unwrap();
    assert!(steps(&run(0)) < 120, "the task has ended before");
    let restarts = slurm(&["scontrol", "show", "job", &format!("{job}_0")]).unwrap();
    assert!(restarts.contains("Restarts=1"), "{restarts}");
    assert!(waits_for(|| remote.path().join("runs/tiny/report.html").is_file()), "no report");
    let status = || finish(with_store(remote.path(), &address, "study status tiny-study.toml"));
    assert!(status().contains("3 done"), "{}", status());
    // A second submission fills the gap alone.
    let text = submit();
    assert!(text.contains("1 tasks"), "{text}");
    assert!(waits_for(|| status().contains("4 done")), "{}", status());
    let matrix = |folder: &Path| fs::read(folder.join("runs/tiny/matrix.json")).unwrap();
    assert!(waits_for(|| matrix(remote.path()) == matrix(local.path())), "the numbers differ");
    assert_same_study(remote.path(), local.path());
}
