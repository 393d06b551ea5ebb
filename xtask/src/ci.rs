//! `cargo xtask ci`: all required checks, fastest first.

use crate::cargo;
use anyhow::{Context, Result, bail};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Instant;

/// Format, house rules, packages, the book, clippy, tests, which include doc tests and a smoke run of the program, and
/// the tests of the Python package.
///
/// Everything is built once, with the wgpu backend, which compiles without a GPU, and with object stores. Their
/// libraries change features of libraries that all crates use: a build apart would compile these twice.
pub fn ci(root: &Path) -> Result<()> {
    const FEATURES: [&str; 2] = ["--features", "lidarshift/wgpu,lidarshift/store"];
    let start = Instant::now();
    step("format", || crate::format::format(root, true))?;
    step("tidy", crate::tidy)?;
    step("package", || crate::package::package(root))?;
    step("book", || book(root))?;
    step("clippy", || {
        let args = ["--quiet", "--workspace", "--all-targets", FEATURES[0], FEATURES[1], "--", "-D", "warnings"];
        component(root, "clippy", &args)
    })?;
    step("test", || must(cargo(root).args(["test", "--workspace", "--no-fail-fast"]).args(FEATURES)))?;
    step("python", || crate::python::test(root, &FEATURES))?;
    eprintln!("ci: all passed in {:.0} s", start.elapsed().as_secs_f64());
    Ok(())
}

/// Runs a component of the toolchain; prints a note if it is not installed.
fn component(root: &Path, name: &str, args: &[&str]) -> Result<()> {
    let there = cargo(root).args([name, "--version"]).stdout(Stdio::null()).stderr(Stdio::null()).status()?;
    if !there.success() {
        eprintln!("cargo {name} is not installed: skipped (rustup component add {name})");
        return Ok(());
    }
    must(cargo(root).arg(name).args(args))
}

/// Builds the book in `docs`; prints a note if mdBook is not installed.
fn book(root: &Path) -> Result<()> {
    let there = Command::new("mdbook").arg("--version").stdout(Stdio::null()).stderr(Stdio::null()).status();
    if !there.is_ok_and(|status| status.success()) {
        eprintln!("mdbook is not installed: the book is not built (cargo install mdbook)");
        return Ok(());
    }
    must(Command::new("mdbook").current_dir(root).args(["build", "docs"]))
}

/// Runs `work` under a heading and prints how long it took; an error carries the name of the step.
fn step(name: &str, work: impl FnOnce() -> Result<()>) -> Result<()> {
    eprintln!("== {name}");
    let start = Instant::now();
    work().with_context(|| format!("ci stopped at: {name}"))?;
    eprintln!("== {name}: {:.0} s", start.elapsed().as_secs_f64());
    Ok(())
}

/// Runs a command; a non-zero exit code is an error.
pub fn must(command: &mut Command) -> Result<()> {
    let status = command.status().with_context(|| format!("could not start {command:?}"))?;
    if !status.success() {
        bail!("{command:?} ended with {status}");
    }
    Ok(())
}
