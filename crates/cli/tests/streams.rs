//! Stdout, stderr and signals: a closed or full stream never stops work, and a training that is stopped is saved.
#![cfg(unix)]

#[allow(dead_code, reason = "each test file uses a part of it")]
mod program;

use program::{data_set, must, output_text, program};
use std::fs::{self, File};
use std::os::unix::process::ExitStatusExt as _;
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

const TRAIN: &str = "train --dataset . --detector tiny.toml --epochs 2";
const SIGINT: i32 = 2;
const SIGPIPE: i32 = 13;
const SIGTERM: i32 = 15;

/// A pipe whose reader is gone.
fn closed() -> Stdio {
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    writer.into()
}

fn full() -> Stdio {
    File::options().write(true).open("/dev/full").unwrap().into()
}

fn signal(child: &Child, name: &str) {
    assert!(Command::new("kill").args([name, &child.id().to_string()]).status().unwrap().success());
}

/// The signals that stop the program. One that this process ignores, as SIGINT in the background of a script, is also
/// ignored by the program.
fn signals() -> Vec<(&'static str, i32)> {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    let ignored = mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).unwrap_or(0);
    let all = [("-TERM", SIGTERM), ("-INT", SIGINT)];
    all.into_iter().filter(|(_, number)| ignored >> (number - 1) & 1 == 0).collect()
}

fn wait_until(what: &str, child: &mut Child, is_true: impl Fn() -> bool) {
    let begin = Instant::now();
    while !is_true() {
        assert!(child.try_wait().unwrap().is_none(), "the program has ended before {what}");
        assert!(begin.elapsed() < Duration::from_secs(60), "no {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

fn ended_by(status: ExitStatus, signal: i32) -> bool {
    status.signal() == Some(signal)
}

#[test]
fn a_training_without_streams_writes_all_results() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    must(dir.path(), &format!("{TRAIN} --out whole"));
    let results = |run: &str| fs::read(dir.path().join(run).join("eval.json")).unwrap();
    type Stream = fn() -> Stdio;
    let streams: [(&str, Stream, Stream); 4] = [
        ("closed", closed, closed),
        ("stderr-closed", Stdio::null, closed),
        ("stderr-full", Stdio::null, full),
        ("both-full", full, full),
    ];
    for (run, stdout, stderr) in streams {
        let status = program(dir.path(), &format!("{TRAIN} --out {run}")).stdout(stdout()).stderr(stderr()).status();
        let status = status.unwrap();
        match run {
            "closed" => assert!(ended_by(status, SIGPIPE), "{run}: {status}"),
            "both-full" => assert_eq!(status.code(), Some(1), "{run}"),
            _ => assert!(status.success(), "{run}: {status}"),
        }
        assert!(results(run) == results("whole") && dir.path().join(run).join("curve.svg").is_file(), "{run}");
    }
}

#[test]
fn a_closed_stdout_ends_each_command_quietly() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    fs::write(dir.path().join("none.toml"), "").unwrap();
    let help = String::from_utf8(must(dir.path(), "--help").stdout).unwrap();
    let commands = help.lines().skip_while(|line| *line != "Commands:").skip(1).take_while(|line| !line.is_empty());
    let names: Vec<&str> =
        commands.filter_map(|line| line.split_whitespace().next()).filter(|n| *n != "help").collect();
    assert!(names.len() > 8, "{names:?}");
    let asked = names.iter().map(|name| format!("{name} --help"));
    let worked = [
        "--version",
        "doctor .",
        "eval statistics . . --split val --json made.json",
        "eval targets . --split val --out made",
        "resim . --effects none.toml --out copy",
        "simulate --config street --frames 3 --out street",
    ];
    for arguments in asked.chain(worked.map(String::from)) {
        let output = program(dir.path(), &arguments).stdout(closed()).output().unwrap();
        let text = output_text(&output);
        assert!(ended_by(output.status, SIGPIPE), "{arguments}: {}: {text}", output.status);
        assert!(!text.contains("panicked") && !text.contains("error"), "{arguments}: {text}");
    }
    for file in ["made.json", "made/report.html", "copy/manifest.json", "street/manifest.json"] {
        assert!(dir.path().join(file).is_file(), "{file}");
    }
    let output = program(dir.path(), "doctor .").stdout(full()).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    assert!(output_text(&output).contains("stdout cannot be written"), "{}", output_text(&output));
}

#[test]
fn a_training_that_is_stopped_is_saved_first() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    let train = "train --dataset . --detector tiny.toml --epochs 30 --set run.checkpoint_every_steps=1000 \
                 --set run.evaluate_every_epochs=100";
    must(dir.path(), &format!("{train} --out whole"));
    let weights = |run: &str| fs::read(dir.path().join(run).join("checkpoint/last.safetensors")).unwrap();
    for (name, number) in signals() {
        let run = format!("stopped{name}");
        let metrics = dir.path().join(&run).join("metrics.jsonl");
        let arguments = format!("{train} --out {run} --resume");
        let mut child = program(dir.path(), &arguments).stderr(Stdio::piped()).stdout(Stdio::null()).spawn().unwrap();
        let steps = || fs::read_to_string(&metrics).map_or(0, |text| text.lines().count());
        wait_until("the first step", &mut child, || steps() > 2);
        signal(&child, name);
        let output = child.wait_with_output().unwrap();
        let text = output_text(&output);
        assert!(ended_by(output.status, number), "{}: {text}", output.status);
        assert!(text.contains("a checkpoint is saved first") && text.contains("stopped after step"), "{text}");
        let state = fs::read_to_string(dir.path().join(&run).join("checkpoint/state.json")).unwrap();
        let state: serde_json::Value = serde_json::from_str(&state).unwrap();
        assert!((1..90).contains(&state["state"]["step"].as_u64().unwrap()), "{state}");
        must(dir.path(), &arguments);
        assert!(weights(&run) == weights("whole"), "the weights differ");
    }
    // Two signals end the program as well.
    let mut child = program(dir.path(), &format!("{train} --out twice")).stderr(Stdio::null()).spawn().unwrap();
    wait_until("the first step", &mut child, || dir.path().join("twice/metrics.jsonl").is_file());
    signal(&child, "-TERM");
    signal(&child, "-TERM");
    assert!(ended_by(child.wait().unwrap(), SIGTERM));
}

#[test]
fn a_stopped_program_removes_its_temporary_folder() {
    let dir = tempfile::tempdir().unwrap();
    let temporary = dir.path().join("tmp");
    fs::create_dir(&temporary).unwrap();
    let entries = |folder: &Path| fs::read_dir(folder).unwrap().count();
    for (name, _) in signals() {
        let mut command = program(dir.path(), "train --smoke");
        let mut child = command.env("TMPDIR", &temporary).stderr(Stdio::null()).spawn().unwrap();
        wait_until("the temporary folder", &mut child, || entries(&temporary) > 0);
        signal(&child, name);
        assert!(child.wait().unwrap().signal().is_some());
        assert_eq!(entries(&temporary), 0);
    }
}

#[test]
fn control_characters_of_names_are_escaped() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    let esc = "\u{1b}";
    let toml = "name = \"red\\u001b[31m\"\nlayout = \"kitti\"\nlabel_frame = \"lidar\"\nclasses = [\"Car\"]\n\
                [splits]\nval = \"ImageSets/val.txt\"\n";
    fs::write(dir.path().join("dataset.toml"), toml).unwrap();
    for (arguments, is_shown) in [
        ("eval targets . --split val".to_string(), true),
        (format!("doctor ./no{esc}[31m"), true),
        (format!("eval statistics . . --split x{esc}[31m"), true),
        (format!("doctor . --x{esc}[31m"), false),
    ] {
        let output = program(dir.path(), &arguments).output().unwrap();
        let text = output_text(&output);
        assert!(!text.contains(esc) && (text.contains("\\u{1b}[31m") || !is_shown), "{arguments:?}: {text:?}");
    }
}
