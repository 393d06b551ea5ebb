//! The program `lidarshift-checks`: what `cargo xtask` runs to check the program `lidarshift` and its crates.

mod bench_step;
mod fuzz;
mod parity;
mod schema;

use anyhow::Result;
use clap::{Parser, Subcommand};
use std::process::ExitCode;

/// Checks of the program by who works on it.
#[derive(Parser, Debug)]
#[command(name = "cargo xtask", bin_name = "cargo xtask", arg_required_else_help = true)]
struct Program {
    #[command(subcommand)]
    check: Check,
}

#[derive(Subcommand, Debug)]
enum Check {
    /// Compare every tensor with a folder of reference numbers
    Parity(parity::ParityArgs),
    /// Feed damaged files to every reader
    Fuzz(fuzz::FuzzArgs),
    /// Time a training step by stage
    BenchStep(bench_step::BenchStepArgs),
    /// Write the JSON schema and the reference of the configuration files
    Schema(schema::SchemaArgs),
}

impl Check {
    /// Whether it passed.
    fn run(self) -> Result<bool> {
        match self {
            Check::Parity(args) => args.run(),
            Check::Fuzz(args) => args.run(),
            Check::BenchStep(args) => args.run().map(|()| true),
            Check::Schema(args) => args.run().map(|()| true),
        }
    }
}

fn main() -> ExitCode {
    // SAFETY: no other thread runs yet.
    unsafe { lidarshift::allocator::keep_memory() };
    match Program::parse().check.run() {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}
