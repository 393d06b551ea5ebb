//! `cargo xtask ci`: all that has to pass, in the order in which it fails fastest.

use crate::{cargo, program};
use anyhow::{Context, Result, bail};
use std::path::Path;
use std::process::Command;
use std::time::Instant;

/// Format, house rules, clippy, tests (doc tests included), then a run through the program.
pub fn ci(root: &Path) -> Result<()> {
    let start = Instant::now();
    step("format", || must(cargo(root).args(["fmt", "--all", "--check"])))?;
    step("tidy", crate::tidy)?;
    step("clippy", || {
        must(cargo(root).args(["clippy", "--quiet", "--workspace", "--all-targets", "--", "-D", "warnings"]))
    })?;
    step("test", || must(cargo(root).args(["test", "--workspace"])))?;
    step("smoke run", || smoke(root))?;
    eprintln!("ci: all passed in {:.0} s", start.elapsed().as_secs_f64());
    Ok(())
}

/// What the README promises, in its smallest form, through the release program in an empty folder.
fn smoke(root: &Path) -> Result<()> {
    let program = program::build(root, None)?;
    let folder = tempfile::tempdir()?;
    let runs: &[&[&str]] = &[&["train", "--smoke"]];
    for args in runs {
        must(Command::new(&program).args(*args).current_dir(folder.path()))?;
    }
    Ok(())
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
