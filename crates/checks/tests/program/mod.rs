//! The program `lidarshift-checks`.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// A folder of reference numbers.
pub fn golden(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden").join(name)
}

/// The program with these words, in `folder`, in which relative paths are looked up.
pub fn program(folder: &Path, words: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_lidarshift-checks"));
    command.args(words.split_whitespace()).current_dir(folder);
    command
}

/// Runs the program to its end.
pub fn run(folder: &Path, words: &str) -> Output {
    program(folder, words).output().expect("the program starts")
}

/// Runs the program, which must succeed.
pub fn must(folder: &Path, words: &str) -> Output {
    let output = run(folder, words);
    assert!(output.status.success(), "{words}: {}", said(&output));
    output
}

/// What it said, on both streams.
pub fn said(output: &Output) -> String {
    format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
}
