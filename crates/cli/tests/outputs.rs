//! Files that the program writes: through what is no regular file, by one writer at a time, and never over its input.
#![cfg(unix)]

#[allow(dead_code, reason = "each test file uses a part of it")]
mod program;

use data::FolderLock;
use program::{data_set, must, output_text, program, run, small_study};
use std::ffi::OsStr;
use std::fs;
use std::os::unix::ffi::OsStrExt as _;
use std::path::Path;
use std::process::{Command, Output};

const TRAIN: &str = "train --dataset . --detector tiny.toml --epochs 1";
const EVAL: &str = "eval ap --labels label_2 --label-frame lidar --detections found --json";
const DETECT: &str = "detect . --checkpoint run/checkpoint/last.safetensors --out";

/// Runs a command line in bash, in which `$P` is the program.
fn bash(folder: &Path, text: &str) -> Output {
    let mut command = Command::new("bash");
    command.args(["-c", text]).env("P", env!("CARGO_BIN_EXE_lidarshift")).current_dir(folder);
    command.output().expect("bash starts")
}

/// The program must fail with exit code 1 and a message with this text.
fn refused(folder: &Path, arguments: &str, wanted: &str) {
    let output = run(folder, arguments);
    let text = output_text(&output);
    assert_eq!(output.status.code(), Some(1), "{arguments}: {text}");
    assert!(text.contains(wanted) && !text.contains("panicked"), "{arguments}: no {wanted:?} in: {text}");
}

/// Detections that equal the labels.
fn found(folder: &Path) {
    fs::create_dir(folder.join("found")).unwrap();
    for entry in fs::read_dir(folder.join("label_2")).unwrap() {
        let path = entry.unwrap().path();
        let text = fs::read_to_string(&path).unwrap();
        let scored: String = text.lines().map(|line| format!("{line} 0.9\n")).collect();
        fs::write(folder.join("found").join(path.file_name().unwrap()), scored).unwrap();
    }
}

#[test]
fn pipes_links_and_devices_stay_what_they_are() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    data_set(dir.path());
    found(dir.path());
    must(dir.path(), &format!("{EVAL} plain.json"));
    let plain = fs::read_to_string(at("plain.json")).unwrap();
    for (text, what) in [
        (format!("set -e; mkfifo pipe; cat pipe > copy & $P {EVAL} pipe; wait; test -p pipe; cat copy"), "a pipe"),
        (format!("$P {EVAL} >(cat > copy); sleep 0.2; cat copy"), "a process substitution"),
        (format!("$P {EVAL} /dev/stdout | head -c {}", plain.len()), "stdout in a pipe"),
        (format!("$P {EVAL} /dev/stdout > both; head -c {} both", plain.len()), "stdout in a file"),
        (format!("$P {EVAL} /dev/fd/5 5> copy; cat copy"), "an open file"),
        (
            format!("mkdir far; ln -s far/target link; $P {EVAL} link; test -L link; cat far/target"),
            "a link to no file",
        ),
        (format!("echo old > far/target; $P {EVAL} link; test -L link; cat far/target"), "a link to a file"),
    ] {
        let output = bash(dir.path(), &text);
        let shown = String::from_utf8_lossy(&output.stdout);
        assert!(output.status.success() && shown.ends_with(&plain), "{what}: {}", output_text(&output));
    }
    assert!(String::from_utf8_lossy(&fs::read(at("both")).unwrap()).len() > plain.len(), "the table is lost");
    // Only root can make a device.
    let device = format!("mknod null c 1 3 2>/dev/null || exit 0; $P {EVAL} null > /dev/null && test -c null");
    assert!(bash(dir.path(), &device).status.success());
    // A link to nothing that can be written, and a folder.
    refused(dir.path(), &format!("{EVAL} found"), "found: cannot be written: it is a folder");
    std::os::unix::fs::symlink("loop", at("loop")).unwrap();
    refused(dir.path(), &format!("{EVAL} loop"), "symbolic links");
    let hidden = |folder: &Path| {
        let names = fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().to_string_lossy().into_owned());
        names.filter(|name| name.starts_with('.')).collect::<Vec<_>>()
    };
    assert!(hidden(dir.path()).is_empty() && hidden(&at("far")).is_empty());
}

#[test]
fn a_folder_has_one_writer_at_a_time() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    must(dir.path(), &format!("{TRAIN} --out run"));
    fs::write(dir.path().join("none.toml"), "").unwrap();
    let set = |name: &str| format!("[[dataset]]\nname = {name:?}\nsource = {{ path = \".\" }}\n");
    let study = format!("name = \"s\"\nabout = []\n{}{}", set("a"), set("b"));
    fs::write(dir.path().join("study.toml"), study).unwrap();
    let busy = dir.path().join("busy");
    let lock = FolderLock::acquire(&busy).unwrap();
    fs::write(busy.join(".writing-first"), "half").unwrap();
    for arguments in [
        "simulate --config street --frames 3 --out busy",
        "resim . --effects none.toml --out busy",
        &format!("{TRAIN} --out busy"),
        &format!("{DETECT} busy"),
        "diagnose --measured . --simulated . --out busy",
        "compare . . --split val --out busy",
        "study study.toml --out busy",
    ] {
        refused(dir.path(), arguments, "busy: is in use by another process (process ");
        assert!(busy.join(".writing-first").is_file(), "{arguments} removed a file of the first writer");
    }
    drop(lock);
    // The first writer was killed before its first file was complete.
    must(dir.path(), "resim . --effects none.toml --out busy");
    assert!(!busy.join(".writing-first").exists() && !busy.join(".lock").exists());
}

#[test]
fn two_simulations_with_one_folder() {
    let dir = tempfile::tempdir().unwrap();
    let arguments = "simulate --config street --frames 6 --out made";
    let children: Vec<_> =
        (0..3).map(|_| program(dir.path(), arguments).stderr(std::process::Stdio::piped()).spawn().unwrap()).collect();
    let outputs: Vec<Output> = children.into_iter().map(|child| child.wait_with_output().unwrap()).collect();
    assert!(outputs.iter().any(|output| output.status.success()));
    for output in outputs.iter().filter(|output| !output.status.success()) {
        assert!(output_text(output).contains("in use by another process"), "{}", output_text(output));
    }
    must(dir.path(), arguments);
}

#[test]
fn files_of_a_kill_before_the_first_manifest_are_removed() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    fs::write(dir.path().join("none.toml"), "").unwrap();
    for (out, arguments) in
        [("a", "simulate --config street --frames 3 --out a"), ("b", "resim . --effects none.toml --out b")]
    {
        fs::create_dir(dir.path().join(out)).unwrap();
        fs::write(dir.path().join(out).join(".writing-abc"), "half").unwrap();
        fs::write(dir.path().join(out).join(".lock"), "process 1").unwrap();
        must(dir.path(), arguments);
        assert!(!dir.path().join(out).join(".writing-abc").exists());
    }
    fs::create_dir(dir.path().join("c")).unwrap();
    fs::write(dir.path().join("c/thesis.txt"), "mine").unwrap();
    refused(dir.path(), "resim . --effects none.toml --out c", "is not empty");
}

#[test]
fn input_is_never_overwritten() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    must(dir.path(), &format!("{TRAIN} --out run"));
    fs::write(dir.path().join("none.toml"), "").unwrap();
    let labels = || fs::read(dir.path().join("label_2/000000.txt")).unwrap();
    let before = labels();
    std::os::unix::fs::symlink("label_2", dir.path().join("link")).unwrap();
    for out in ["label_2", "link", "run/../label_2", "velodyne", "./label_2/new"] {
        refused(dir.path(), &format!("{DETECT} {out}"), "would be overwritten");
    }
    for (arguments, wanted) in [
        ("resim . --effects none.toml --out .", "is the folder of the data set"),
        ("resim . --effects none.toml --out velodyne", "would be overwritten"),
        ("diagnose --measured . --simulated . --out .", "is the folder of the data set"),
        ("diagnose --measured . --simulated . --out velodyne", "would be overwritten"),
        ("compare . . --split val --out label_2", "would be overwritten"),
        (&format!("{TRAIN} --out label_2"), "would be overwritten"),
        (
            "detect velodyne/000000.bin --checkpoint run/checkpoint/last.safetensors --json velodyne/000000.bin",
            "would be overwritten",
        ),
    ] {
        refused(dir.path(), arguments, wanted);
    }
    assert!(labels() == before);
    must(dir.path(), &format!("{DETECT} label_2/../found"));
}

#[test]
fn a_result_that_cannot_be_written_ends_long_work_before_it_begins() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    fs::write(dir.path().join("plain"), "").unwrap();
    for arguments in ["diagnose --measured . --simulated . --out out", "compare . . --split val --out out"] {
        refused(dir.path(), &format!("{arguments} --json plain/a.json"), "plain");
        assert!(!dir.path().join("out").exists(), "{arguments}");
    }
}

#[test]
fn a_diagnosis_removes_the_files_of_the_one_before() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    let diagnose = "diagnose --measured . --simulated . --out out";
    must(dir.path(), diagnose);
    let out = dir.path().join("out");
    let stale = ["finding-1-rain.svg", "finding-1-rain.png", "label_2/000000.txt", "label_2_high/000000.txt"];
    let write = |name: &str| data::write_atomic(&out.join(name), b"of another pair").unwrap();
    stale.into_iter().chain(["thesis.txt"]).for_each(write);
    let before = fs::read(out.join("diagnosis.json")).unwrap();
    must(dir.path(), diagnose);
    for name in stale {
        assert!(!out.join(name).exists(), "{name} is of the diagnosis before");
    }
    assert!(out.join("thesis.txt").is_file() && out.join("extended.toml").is_file());
    assert!(fs::read(out.join("diagnosis.json")).unwrap() == before, "another result for the same pair");
}

#[test]
fn names_that_are_not_utf_8() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    let name = OsStr::from_bytes(b"out-\xff");
    let out = dir.path().join(name);
    let with_out = |arguments: &str| {
        let output = program(dir.path(), arguments).arg(name).output().unwrap();
        assert!(output.status.success(), "{arguments}: {}", output_text(&output));
    };
    with_out(&format!("{TRAIN} --out"));
    assert!(out.join("eval.json").is_file());
    let weights = "run-2/checkpoint/last.safetensors";
    fs::rename(&out, dir.path().join("run-2")).unwrap();
    with_out(&format!("detect . --checkpoint {weights} --out"));
    assert!(out.join("000000.txt").is_file());
    fs::remove_dir_all(&out).unwrap();
    with_out("simulate --config street --frames 3 --out");
    assert!(out.join("manifest.json").is_file());
    for (arguments, wanted) in [
        ("train --detector tiny.toml --dataset", "is not UTF-8"),
        ("compare . . --split val --out", "has to be UTF-8"),
        ("study quick --only data --out", "has to be UTF-8"),
    ] {
        let output = program(dir.path(), arguments).arg(name).output().unwrap();
        assert_eq!(output.status.code(), Some(1), "{arguments}");
        assert!(output_text(&output).contains(wanted), "{arguments}: {}", output_text(&output));
    }
}

#[test]
fn a_dry_run_writes_no_data() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    small_study(dir.path(), "");
    let study = |more: &str| output_text(&must(dir.path(), &format!("study study.toml {more}")));
    let before = study("--dry-run");
    assert!(before.contains("would be generated: changed") && before.contains("2 runs"), "{before}");
    assert!(!dir.path().join("runs").exists());
    study("--only data");
    let files = || {
        let list = bash(dir.path(), "find runs -type f | sort");
        String::from_utf8(list.stdout).unwrap()
    };
    let made = files();
    let after = study("--dry-run");
    assert!(after.contains("2 runs, ") && after.contains("about"), "{after}");
    assert_eq!(files().replace("runs/small/costs.json\n", ""), made);
}
