//! `cargo xtask COMMAND ...`: workspace tasks, some of them run by the program `lidarshift-checks`; any other command
//! is passed to the program `lidarshift`. Both programs are built in release.

mod bench;
mod bench_gpu;
mod bench_kills;
mod bench_mutants;
mod bench_train;
mod ci;
mod format;
mod package;
mod pages;
mod program;
mod python;
mod tidy;

use anyhow::{Result, bail};
use clap::{Parser, Subcommand};
use program::Program::{Checks, Lidarshift};
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

/// Workspace tasks. Every other command (train, eval, simulate, detect, doctor, ...) is passed to the program
/// `lidarshift`, built in release with the backend required by `--device`.
#[derive(Parser)]
#[command(
    name = "cargo xtask",
    bin_name = "cargo xtask",
    arg_required_else_help = true,
    disable_help_subcommand = true,
    after_help = "Any other command is passed to the program: `cargo xtask train --help`; `cargo xtask help` lists all."
)]
struct Xtask {
    #[command(subcommand)]
    task: Task,
}

#[derive(Subcommand)]
enum Task {
    /// Run all required checks: format, house rules, clippy, tests, a smoke run.
    Ci,
    /// Format all sources, including those named by macros.
    Format {
        /// Only check whether they are formatted.
        #[arg(long)]
        check: bool,
    },
    /// Check the house rules: dependencies between crates, lints, file names and lengths, machine paths, wording, links
    /// between pages.
    Tidy,
    /// Write configs/schema.json and docs/src/reference/configuration.md from the Rust types.
    Schema,
    /// Run the benchmarks. NAME is a benchmark or a crate; further arguments go to Criterion. `bench train` compares
    /// training steps with PyTorch; `bench gpu` times the networks on the GPU of this machine (`bench gpu -- --help`);
    /// `bench mutants` runs the blind cases against a diagnosis with deliberate defects;
    /// `bench kills` ends commands by signals and repeats them;
    /// `bench loop -- --help` applies diagnoses to the simulated data and diagnoses again; `bench town -- --help`
    /// diagnoses pairs of the second generator.
    Bench {
        /// A benchmark (`crates/*/benches/NAME.rs`), a crate folder, `gpu`, `train`, `mutants` or `kills`; default: all
        /// benchmarks of crates.
        name: Option<String>,
        /// Arguments for Criterion, such as `--quick` or a filter; for `train` and `mutants`: parts of the wanted ids;
        /// for `kills`: the number of signals, and commands such as `twin`.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        args: Vec<String>,
    },
    /// Compare every tensor with a folder of reference numbers: `parity ../shared/golden/pointpillars_tiny`.
    #[command(disable_help_flag = true)]
    Parity {
        /// Arguments of `lidarshift-checks parity`.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        args: Vec<OsString>,
    },
    /// Time a training step by stage.
    #[command(hide = true, disable_help_flag = true)]
    BenchStep {
        /// Arguments of `lidarshift-checks bench-step`.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        args: Vec<OsString>,
    },
    /// Test every file reader with mutated inputs: `fuzz --inputs 1000000`.
    #[command(disable_help_flag = true)]
    Fuzz {
        /// Arguments of `lidarshift-checks fuzz`.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        args: Vec<OsString>,
    },
    /// A command of the program.
    #[command(external_subcommand)]
    Program(Vec<OsString>),
}

fn main() -> ExitCode {
    let outcome = match Xtask::parse().task {
        Task::Ci => ci::ci(&root()),
        Task::Format { check } => format::format(&root(), check),
        Task::Tidy => tidy(),
        Task::Schema => program::run(&root(), Checks, &["schema".into()]),
        Task::Bench { name, args } => bench::bench(&root(), name.as_deref(), &args),
        Task::Parity { args } => program::hand_over(&root(), Checks, &[vec!["parity".into()], args].concat()),
        Task::BenchStep { args } => program::hand_over(&root(), Checks, &[vec!["bench-step".into()], args].concat()),
        Task::Fuzz { args } => program::hand_over(&root(), Checks, &[vec!["fuzz".into()], args].concat()),
        Task::Program(args) => program::hand_over(&root(), Lidarshift, &args),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn tidy() -> Result<()> {
    let complaints = tidy::complaints(&root())?;
    for complaint in &complaints {
        eprintln!("{complaint}");
    }
    match complaints.len() {
        0 => Ok(()),
        n => bail!("tidy: {n} complaints"),
    }
}

/// Root folder of the workspace.
fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("xtask is in the workspace").into()
}

/// The cargo that runs xtask, in the workspace root.
fn cargo(root: &Path) -> Command {
    let mut command = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    command.current_dir(root);
    command
}
