//! The tests of the Python package.
//!
//! The extension module is built with the features of the other tests, so that nothing is compiled for it alone. The
//! package is put together in `target/python`. numpy and pytest are installed into `target/python-venv`.

use crate::cargo;
use anyhow::{Context, Result, bail};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// What the tests import.
const NEEDED: [&str; 2] = ["numpy", "pytest"];

/// What some tests import, which are left out without it.
const OPTIONAL: [&str; 2] = ["onnxruntime", "mcap-ros2-support"];

/// Builds the extension module and runs the tests; prints a note if there is no Python or no package index.
pub fn test(root: &Path, features: &[&str]) -> Result<()> {
    let Some(python) = environment(root)? else { return Ok(()) };
    build(root, features)?;
    let package = assemble(root)?;
    let mut tests = Command::new(python);
    tests.current_dir(root).env("PYTHONPATH", &package).env("PYTHONDONTWRITEBYTECODE", "1");
    tests.args(["-m", "pytest", "-q", "-p", "no:cacheprovider", "crates/python/tests"]);
    let status = tests.status().with_context(|| format!("could not start {tests:?}"))?;
    if !status.success() {
        bail!("the tests of the Python package ended with {status}");
    }
    Ok(())
}

/// The interpreter of an environment in which the tests run; `None` if there is none.
fn environment(root: &Path) -> Result<Option<PathBuf>> {
    let folder = root.join("target/python-venv");
    let python = folder.join(if cfg!(windows) { "Scripts/python.exe" } else { "bin/python" });
    let works = |command: &mut Command| {
        command.stdout(Stdio::null()).stderr(Stdio::null()).status().is_ok_and(|status| status.success())
    };
    let imports = || works(Command::new(&python).args(["-c", &format!("import {}", NEEDED.join(", "))]));
    if imports() {
        return Ok(Some(python));
    }
    let skipped = |why: &str| {
        eprintln!("SKIPPED: the Python package is not tested: {why}");
        Ok(None)
    };
    let system = if cfg!(windows) { "python" } else { "python3" };
    if !works(Command::new(system).args(["-c", "import sys; sys.exit(sys.version_info < (3, 9))"])) {
        return skipped("there is no Python 3.9 or newer");
    }
    if !works(Command::new(system).args(["-m", "venv"]).arg(&folder)) {
        return skipped("python3 -m venv does not work (on Debian: apt install python3-venv)");
    }
    let pip = ["-m", "pip", "install", "--quiet", "--disable-pip-version-check"];
    if !works(Command::new(&python).args(pip).args(NEEDED)) || !imports() {
        return skipped("pip cannot install numpy and pytest into target/python-venv: no package index?");
    }
    for package in OPTIONAL {
        if !works(Command::new(&python).args(pip).arg(package)) {
            eprintln!("SKIPPED: pip cannot install {package}: the tests that need it are left out");
        }
    }
    Ok(Some(python))
}

/// Builds the extension module and the program, with the features of dependencies that `cargo test` has.
fn build(root: &Path, features: &[&str]) -> Result<()> {
    let mut build = cargo(root);
    build.args(["build", "--quiet", "--workspace", "--lib", "--bins", "--tests"]).args(features);
    let status = build.status()?;
    if !status.success() {
        bail!("{build:?} ended with {status}");
    }
    Ok(())
}

/// Puts the package together; returns the folder that has it.
fn assemble(root: &Path) -> Result<PathBuf> {
    let package = root.join("target/python");
    let to = package.join("lidarshift");
    std::fs::create_dir_all(&to)?;
    let from = root.join("crates/python/python/lidarshift");
    for entry in std::fs::read_dir(&from)? {
        let path = entry?.path();
        if let Some(name) = path.file_name().filter(|_| path.is_file()) {
            std::fs::copy(&path, to.join(name))?;
        }
    }
    let (prefix, ending, module) = match std::env::consts::OS {
        "windows" => ("", "dll", "_native.pyd"),
        "macos" => ("lib", "dylib", "_native.abi3.so"),
        _ => ("lib", "so", "_native.abi3.so"),
    };
    let built = root.join(format!("target/debug/{prefix}lidarshift_native.{ending}"));
    // A library that another process has loaded is replaced, not overwritten.
    let target = to.join(module);
    if target.exists() {
        std::fs::remove_file(&target)?;
    }
    std::fs::copy(&built, &target).with_context(|| format!("{} was not built", built.display()))?;
    Ok(package)
}
