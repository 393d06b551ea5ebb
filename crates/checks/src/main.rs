//! The program `lidarshift-checks`: checks of `lidarshift` and its crates, started by `cargo xtask`.

mod bench_step;
mod fuzz;
mod parity;
mod schema;

use anyhow::Result;
use clap::{Parser, Subcommand};
use lidarshift::{errln, outln};
use std::process::ExitCode;

/// Checks for developers.
#[derive(Parser, Debug)]
#[command(name = "cargo xtask", bin_name = "cargo xtask", arg_required_else_help = true)]
struct Program {
    #[command(subcommand)]
    check: Check,
}

#[derive(Subcommand, Debug)]
enum Check {
    /// Compare all tensors of a network with reference values
    Parity(parity::ParityArgs),
    /// Test all file readers with damaged files
    Fuzz(fuzz::FuzzArgs),
    /// Measure the time of each stage of a training step
    BenchStep(bench_step::BenchStepArgs),
    /// Print the adapters of the device wgpu, and the features of this program, as JSON
    #[command(hide = true)]
    Adapters,
    /// Write the JSON schema and the Markdown reference of the configuration files
    Schema(schema::SchemaArgs),
}

impl Check {
    /// Whether it passed.
    fn run(self) -> Result<bool> {
        match self {
            Check::Parity(args) => args.run(),
            Check::Fuzz(args) => args.run(),
            Check::BenchStep(args) => args.run().map(|()| true),
            Check::Adapters => {
                let adapters = lidarshift::device::adapters();
                let found = serde_json::json!({
                    "build": data::build_id(),
                    "features": lidarshift::FEATURES,
                    "adapters": adapters,
                });
                outln!("{found}");
                Ok(true)
            }
            Check::Schema(args) => args.run().map(|()| true),
        }
    }
}

fn main() -> ExitCode {
    // SAFETY: no other thread runs yet.
    unsafe { lidarshift::allocator::keep_memory() };
    lidarshift::name_build();
    let code = match Program::parse().check.run() {
        Ok(true) => 0,
        Ok(false) => 1,
        Err(error) => {
            errln!("error: {error:#}");
            1
        }
    };
    ExitCode::from(lidarshift::console::end(code))
}
