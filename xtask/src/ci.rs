//! `cargo xtask ci`: all that has to pass, in the order in which it fails fastest.

use crate::cargo;
use anyhow::{Context, Result, bail};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Instant;

/// Format, house rules, the book, clippy, tests: doc tests and the smallest default run through the program are among them.
///
/// Everything is built once, with wgpu in it, which compiles without a GPU.
pub fn ci(root: &Path) -> Result<()> {
    const FEATURES: [&str; 2] = ["--features", "lidarshift/wgpu"];
    let start = Instant::now();
    step("format", || crate::format::format(root, true))?;
    step("tidy", crate::tidy)?;
    step("book", || book(root))?;
    step("clippy", || {
        let words = ["--quiet", "--workspace", "--all-targets", FEATURES[0], FEATURES[1], "--", "-D", "warnings"];
        component(root, "clippy", &words)
    })?;
    step("test", || must(cargo(root).args(["test", "--workspace"]).args(FEATURES)))?;
    eprintln!("ci: all passed in {:.0} s", start.elapsed().as_secs_f64());
    Ok(())
}

/// A component of the toolchain; where it is not installed, that is said.
fn component(root: &Path, name: &str, words: &[&str]) -> Result<()> {
    let there = cargo(root).args([name, "--version"]).stdout(Stdio::null()).stderr(Stdio::null()).status()?;
    if !there.success() {
        eprintln!("cargo {name} is not installed: skipped (rustup component add {name})");
        return Ok(());
    }
    must(cargo(root).arg(name).args(words))
}

/// Builds the book of `docs`; where mdBook is not installed, that is said.
fn book(root: &Path) -> Result<()> {
    let there = Command::new("mdbook").arg("--version").stdout(Stdio::null()).stderr(Stdio::null()).status();
    if !there.is_ok_and(|status| status.success()) {
        eprintln!("mdbook is not installed: the book is not built (cargo install mdbook)");
        return Ok(());
    }
    must(Command::new("mdbook").current_dir(root).args(["build", "docs"]))
}

/// Runs `work` under a heading; an error carries the step's name.
fn step(name: &str, work: impl FnOnce() -> Result<()>) -> Result<()> {
    eprintln!("== {name}");
    work().with_context(|| format!("ci stopped at: {name}"))
}

/// Runs a command; an exit code other than 0 is an error.
fn must(command: &mut Command) -> Result<()> {
    let status = command.status().with_context(|| format!("could not start {command:?}"))?;
    if !status.success() {
        bail!("{command:?} ended with {status}");
    }
    Ok(())
}
