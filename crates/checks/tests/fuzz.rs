//! A short mutation run of every reader, through the program: memory is that of the process.

#[allow(dead_code, reason = "each test file uses a part of it")]
mod program;

use program::{must, run};
use std::path::Path;

#[test]
fn readers_stand_damage() {
    let output = must(Path::new("."), "fuzz --inputs 2000 --seed 1");
    let text = String::from_utf8(output.stdout).unwrap();
    assert_eq!(text.lines().filter(|line| line.contains(" 0 broken")).count(), 15, "{text}");
}

#[test]
fn a_name_that_no_reader_has_is_an_error() {
    assert!(!run(Path::new("."), "fuzz --only nothing").status.success());
}
