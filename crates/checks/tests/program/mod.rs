//! Runs the program `lidarshift-checks`.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// A folder with reference values.
pub fn golden(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden").join(name)
}

/// The program with these arguments and the working directory `folder`.
pub fn program(folder: &Path, arguments: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_lidarshift-checks"));
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
