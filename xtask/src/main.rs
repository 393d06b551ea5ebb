//! `cargo xtask WORD ...`: the program `lidarshift`, built in release and run with the same words; and the chores of who works on it, some of
//! which the program `lidarshift-checks` does.

mod bench;
mod bench_mutants;
mod bench_train;
mod ci;
mod format;
mod pages;
mod program;
mod tidy;

use anyhow::{Result, bail};
use clap::{Parser, Subcommand};
use program::Program::{Checks, Lidarshift};
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

/// Chores of the workspace; every other word (train, eval, simulate, detect, doctor, ...) goes to the program
/// `lidarshift`, built in release with the backend that `--device` asks for.
#[derive(Parser)]
#[command(
    name = "cargo xtask",
    bin_name = "cargo xtask",
    arg_required_else_help = true,
    disable_help_subcommand = true,
    after_help = "Any other word goes to the program: `cargo xtask train --help`, `cargo xtask help` for all of them."
)]
struct Xtask {
    #[command(subcommand)]
    word: Word,
}

#[derive(Subcommand)]
enum Word {
    /// All that has to pass: format, house rules, clippy, tests, a smoke run. The README's test command.
    Ci,
    /// Format all sources, those that macros name included.
    Format {
        /// Only say whether they are formatted.
        #[arg(long)]
        check: bool,
    },
    /// The house rules: arrows between crates, lints, file names and lengths, no machine paths, links between pages.
    Tidy,
    /// Write configs/schema.json and docs/src/reference/configuration.md from the Rust types.
    Schema,
    /// Run the benchmarks; NAME is a benchmark or a crate, further words go to Criterion. `bench train` times training steps beside PyTorch's;
    /// `bench mutants` breaks the diagnosis in many ways and sees whether the blind cases notice.
    Bench {
        /// A benchmark (`crates/*/benches/NAME.rs`), the folder of a crate, `train` or `mutants`; all but these two when left out.
        name: Option<String>,
        /// For Criterion, as `--quick` or a filter; for `train` parts of the ids of the wanted rows.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        words: Vec<String>,
    },
    /// Compare every tensor with a folder of reference numbers: `parity ../shared/golden/pointpillars_tiny`.
    #[command(disable_help_flag = true)]
    Parity {
        /// For the `parity` of `lidarshift-checks`.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        args: Vec<OsString>,
    },
    /// Time a training step by stage.
    #[command(hide = true, disable_help_flag = true)]
    BenchStep {
        /// For the `bench-step` of `lidarshift-checks`.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        args: Vec<OsString>,
    },
    /// Face every reader of files with mutated inputs: `fuzz --inputs 1000000`.
    #[command(disable_help_flag = true)]
    Fuzz {
        /// For the `fuzz` of `lidarshift-checks`.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        args: Vec<OsString>,
    },
    /// A word of the program.
    #[command(external_subcommand)]
    Program(Vec<OsString>),
}

fn main() -> ExitCode {
    let outcome = match Xtask::parse().word {
        Word::Ci => ci::ci(&root()),
        Word::Format { check } => format::format(&root(), check),
        Word::Tidy => tidy(),
        Word::Schema => program::run(&root(), Checks, &["schema".into()]),
        Word::Bench { name, words } => bench::bench(&root(), name.as_deref(), &words),
        Word::Parity { args } => program::hand_over(&root(), Checks, &[vec!["parity".into()], args].concat()),
        Word::BenchStep { args } => program::hand_over(&root(), Checks, &[vec!["bench-step".into()], args].concat()),
        Word::Fuzz { args } => program::hand_over(&root(), Checks, &[vec!["fuzz".into()], args].concat()),
        Word::Program(args) => program::hand_over(&root(), Lidarshift, &args),
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

/// The folder of the workspace.
fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("xtask lies in the workspace").into()
}

/// The cargo that runs us, in the folder of the workspace.
fn cargo(root: &Path) -> Command {
    let mut command = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    command.current_dir(root);
    command
}
