//! `--errors json`: one object, the last line of stderr, with the exit code and the place of the error.

#[allow(dead_code, reason = "each test file uses a part of it")]
mod program;

use program::{data_set, run};
use serde_json::{Value, json};
use std::fs;
use std::path::Path;

/// The object of a command, whose exit code it has to name.
fn error_of(folder: &Path, arguments: &str) -> Value {
    let output = run(folder, arguments);
    let stderr = String::from_utf8(output.stderr).unwrap();
    let last = stderr.lines().last().unwrap_or_default();
    let found: Value = serde_json::from_str(last).unwrap_or_else(|e| panic!("{arguments}: {e}: {stderr}"));
    assert_eq!(found["schema"], "lidarshift/error/1", "{arguments}");
    assert_eq!(found["code"], json!(output.status.code()), "{arguments}: {stderr}");
    assert!(!stderr.contains("error: "), "{arguments}: {stderr}");
    assert_eq!(stderr.lines().filter(|line| line.starts_with('{')).count(), 1, "{arguments}: {stderr}");
    found
}

#[test]
fn errors_have_code_kind_file_line_and_hint() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    let write = |path: &str, text: &str| fs::write(dir.path().join(path), text).unwrap();
    write("bad.toml", "[[effect]]\nkind = \"range_noise\"\nstd = 0.1\n");
    write("syntax.toml", "name = \"tiny\"\nchannels = = 4\n");
    write("label_2/000003.txt", "Car 0 0 0 0 0 0 0 1.5 1.6 3.9 5 0 -1\n");
    write("short.bin", "12345");
    write("weights.safetensors", "no weights");
    for (arguments, code, kind, file, line, hint, message) in [
        (
            "resim . --effects bad.toml --out out",
            1,
            "invalid",
            "bad.toml",
            3,
            "did you mean `std_m`?",
            "unknown field `std`",
        ),
        ("train --dataset . --detector syntax.toml", 1, "invalid", "syntax.toml", 2, "", "syntax.toml:2:"),
        ("doctor nowhere", 1, "missing", "nowhere", 0, "give the folder", "nowhere: does not exist"),
        ("eval ap --dataset . --split val --detections nowhere", 1, "missing", "nowhere", 0, "", "nowhere"),
        (
            "diagnose --measured . --simulated .",
            1,
            "invalid",
            "label_2/000003.txt",
            1,
            "",
            "15 values; this line has 14",
        ),
        ("detect short.bin --checkpoint none.pth --detector tiny.toml", 1, "missing", "none.pth", 0, "", "none.pth"),
        (
            "detect short.bin --checkpoint weights.safetensors --detector tiny.toml",
            1,
            "invalid",
            "weights.safetensors",
            0,
            "",
            "weights.safetensors",
        ),
        ("convert . --to pcd --out velodyne", 1, "refused", "velodyne", 0, "choose another --out", "overwritten"),
        ("convert . --to pcd --out bad.toml/out", 1, "missing", "bad.toml/out", 0, "", "bad.toml"),
        ("study no-such-study", 1, "refused", "", 0, "", "no-such-study"),
        ("doctor . --jason x", 2, "usage", "", 0, "did you mean `--json`?", "unexpected argument '--jason'"),
        ("docter .", 2, "usage", "", 0, "did you mean `doctor`?", "unrecognized subcommand 'docter'"),
        ("resim .", 2, "usage", "", 0, "see --help", "--effects"),
        ("eval ap --labels x --detections y --max-range=-1", 2, "usage", "", 0, "", "--max-range"),
        ("eval", 2, "usage", "", 0, "see --help", "the command is missing"),
    ] {
        for arguments in [format!("{arguments} --errors json"), format!("--errors=json {arguments}")] {
            let found = error_of(dir.path(), &arguments);
            assert_eq!((&found["code"], &found["kind"]), (&json!(code), &json!(kind)), "{arguments}: {found}");
            let text = |key: &str| found[key].as_str().unwrap_or_default();
            assert!(text("file").ends_with(file) && text("file").is_empty() == file.is_empty(), "{arguments}: {found}");
            assert_eq!(found["line"].as_u64().unwrap_or(0), line, "{arguments}: {found}");
            assert!(text("hint").contains(hint), "{arguments}: {found}");
            assert!(text("message").contains(message), "{arguments}: {found}");
        }
    }
}

#[test]
fn a_folder_in_use_is_a_kind_of_its_own() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    fs::write(dir.path().join("none.toml"), "").unwrap();
    let _lock = data::FolderLock::acquire(&dir.path().join("busy")).unwrap();
    let found = error_of(dir.path(), "resim . --effects none.toml --out busy --errors json");
    assert_eq!((&found["kind"], &found["file"]), (&json!("in_use"), &json!("busy")));
    assert!(found["hint"].as_str().unwrap().starts_with("wait until it ends"), "{found}");
}

#[test]
fn a_check_that_fails_is_an_error_too() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    for i in 0..7 {
        fs::write(dir.path().join(format!("label_2/{i:06}.txt")), "").unwrap();
    }
    let found = error_of(dir.path(), "doctor . --errors json");
    assert_eq!((&found["code"], &found["kind"], &found["file"]), (&json!(1), &json!("check_failed"), &Value::Null));
}

#[test]
fn the_message_is_that_of_the_text() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    for (arguments, code) in [("doctor nowhere", 1), ("resim . --effects none.toml --out out", 1)] {
        let found = error_of(dir.path(), &format!("{arguments} --errors json"));
        let output = run(dir.path(), arguments);
        assert_eq!(output.status.code(), Some(code));
        let text = String::from_utf8(output.stderr).unwrap();
        assert_eq!(text, format!("error: {}\n", found["message"].as_str().unwrap()));
        assert_eq!(run(dir.path(), &format!("{arguments} --errors text")).stderr, text.as_bytes());
    }
    // What is no error is not changed.
    let version = run(dir.path(), "--version --errors json");
    assert!(version.status.success() && version.stderr.is_empty());
    assert_eq!(run(dir.path(), "doctor --help --errors json").stdout, run(dir.path(), "doctor --help").stdout);
}

/// Names of files may hold control characters and those that change the direction of text.
#[cfg(unix)]
#[test]
fn an_object_is_one_line_of_json_for_any_name() {
    let dir = tempfile::tempdir().unwrap();
    let name = "a\u{1b}[31m\u{202e}\"\n\u{9b}";
    let output = std::process::Command::new(env!("CARGO_BIN_EXE_lidarshift"))
        .args(["doctor", name, "--errors", "json"])
        .current_dir(dir.path())
        .output()
        .unwrap();
    let text = String::from_utf8(output.stderr).unwrap();
    assert_eq!(text.lines().count(), 1, "{text:?}");
    assert!(!text.trim_end().contains(|c: char| c.is_control() || c == '\u{202e}'), "{text:?}");
    let found: Value = serde_json::from_str(&text).unwrap();
    assert_eq!(found["file"], name);
}
