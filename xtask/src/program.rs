//! The programs `lidarshift` and `lidarshift-checks`: built in release with the requested backend, then run with the
//! caller's arguments.

use crate::cargo;
use anyhow::{Context, Result, bail, ensure};
use std::ffi::{OsStr, OsString};
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::Duration;

/// A build that takes longer than this is announced.
const SILENCE: Duration = Duration::from_millis(1500);

/// A program of the workspace.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Program {
    /// The program for users.
    Lidarshift,
    /// The program with the checks of it: `parity`, `fuzz`, `bench-step`, `schema`.
    Checks,
}

impl Program {
    /// Name of its package and of its executable.
    fn name(self) -> &'static str {
        match self {
            Program::Lidarshift => "lidarshift",
            Program::Checks => "lidarshift-checks",
        }
    }
}

/// Builds a program and replaces this process with it: same working folder, arguments and exit code; signals reach it
/// directly.
pub fn hand_over(root: &Path, program: Program, args: &[OsString]) -> Result<()> {
    let mut program = Command::new(build(root, program, backend_feature(args))?);
    program.args(args);
    #[cfg(unix)]
    {
        use std::os::unix::process::CommandExt;
        let error = program.exec();
        Err(error).with_context(|| format!("could not start {}", program.get_program().display()))
    }
    #[cfg(not(unix))]
    {
        let status =
            program.status().with_context(|| format!("could not start {}", program.get_program().display()))?;
        std::process::exit(status.code().unwrap_or(1))
    }
}

/// Builds a program and runs it in the workspace root; a non-zero exit code is an error.
pub fn run(root: &Path, program: Program, args: &[OsString]) -> Result<()> {
    let status = Command::new(build(root, program, backend_feature(args))?).args(args).current_dir(root).status()?;
    if !status.success() {
        bail!("{} {} ended with {status}", program.name(), args.join(OsStr::new(" ")).display());
    }
    Ok(())
}

/// Runs a command and returns its stdout.
pub fn output(command: &mut Command) -> Result<Vec<u8>> {
    let name = command.get_program().display().to_string();
    let output = command.output().with_context(|| format!("could not start {name}"))?;
    ensure!(output.status.success(), "{name} failed: {}", String::from_utf8_lossy(&output.stderr).trim());
    Ok(output.stdout)
}

/// Path of a program, built in release, with an additional backend feature if requested.
pub fn build(root: &Path, program: Program, feature: Option<&str>) -> Result<PathBuf> {
    let name = program.name();
    let mut cargo = cargo(root);
    cargo.args(["build", "--quiet", "--release", "--package", name, "--bin", name]);
    cargo.arg("--message-format=json-render-diagnostics");
    if let Some(feature) = feature {
        cargo.args(["--features", feature]);
    }
    let (done, is_done) = channel::<()>();
    let announcer = std::thread::spawn(move || {
        if is_done.recv_timeout(SILENCE) == Err(RecvTimeoutError::Timeout) {
            eprintln!("building {name} (release)...");
        }
    });
    let mut build = cargo.stdout(Stdio::piped()).spawn().context("could not start cargo")?;
    let mut executable = None;
    for line in BufReader::new(build.stdout.take().expect("piped")).lines() {
        executable = executable_of(&line?).or(executable);
    }
    let status = build.wait()?;
    drop(done);
    announcer.join().expect("the announcing thread does not panic");
    if !status.success() {
        bail!("the program {name} could not be built");
    }
    executable.with_context(|| format!("cargo reported no executable of {name}"))
}

/// The executable named in one line of cargo's JSON messages.
fn executable_of(line: &str) -> Option<PathBuf> {
    let message: serde_json::Value = serde_json::from_str(line).ok()?;
    message["executable"].as_str().map(PathBuf::from)
}

/// The cargo feature required by `--device wgpu` or `--device=cuda`; `None` for the default backends.
fn backend_feature(args: &[OsString]) -> Option<&'static str> {
    let args: Vec<_> = args.iter().map(|a| a.to_string_lossy()).take_while(|a| a != "--").collect();
    let after =
        args.iter().zip(args.iter().skip(1)).filter(|(a, _)| *a == "--device").map(|(_, device)| device.as_ref());
    let joined = args.iter().filter_map(|a| a.strip_prefix("--device="));
    after.chain(joined).find_map(|device| ["wgpu", "cuda"].into_iter().find(|f| device.split(':').next() == Some(f)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn device_chooses_the_feature() {
        for (line, want) in [
            ("train", None),
            ("train --device flex", None),
            ("train --device wgpu --seed 3", Some("wgpu")),
            ("parity dir --device=cuda", Some("cuda")),
            ("detect a.bin --device wgpu:1", Some("wgpu")),
            ("train --out wgpu", None),
            ("train --device", None),
        ] {
            let args: Vec<OsString> = line.split(' ').map(OsString::from).collect();
            assert_eq!(backend_feature(&args), want, "{line}");
        }
    }

    #[test]
    fn cargo_names_the_executable() {
        let artifact = r#"{"reason":"compiler-artifact","executable":"/t/release/lidarshift","fresh":true}"#;
        assert_eq!(executable_of(artifact), Some("/t/release/lidarshift".into()));
        assert_eq!(executable_of(r#"{"reason":"compiler-artifact","executable":null}"#), None);
        assert_eq!(executable_of("no json"), None);
    }
}
