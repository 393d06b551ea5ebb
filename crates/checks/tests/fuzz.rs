//! A short fuzz run of every reader in a separate process, so that its memory can be measured.

#[allow(dead_code, reason = "each test file uses a part of it")]
mod program;

use program::{must, run};
use std::path::Path;

#[test]
fn readers_handle_damaged_files() {
    let output = must(Path::new("."), "fuzz --inputs 2000 --seed 1");
    let text = String::from_utf8(output.stdout).unwrap();
    assert_eq!(text.lines().filter(|line| line.contains(" 0 broken")).count(), 50, "{text}");
}

#[test]
fn an_unknown_reader_is_an_error() {
    assert!(!run(Path::new("."), "fuzz --only nothing").status.success());
}
