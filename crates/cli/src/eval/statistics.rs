//! `lidarshift eval statistics`: two data sets of the same frames beside each other.

use anyhow::Result;
use clap::Args;
use data::{Dataset, write_json};
use eval::compare_statistics;
use std::path::PathBuf;

/// Points and boxes of two data sets of the same frames: the paper's Table I for any pair.
///
/// Examples:
///   lidarshift eval statistics datasets/race/measured datasets/race/sim
///   lidarshift eval statistics datasets/race/measured datasets/race/sim --split test --json statistics.json
#[derive(Args, Debug)]
#[command(verbatim_doc_comment)]
pub struct EvalStatisticsArgs {
    /// First data set: its folder or its TOML
    #[arg(value_name = "A")]
    a: PathBuf,
    /// Second data set, with the same frames under the same names
    #[arg(value_name = "B")]
    b: PathBuf,
    /// Split of the first whose frames are counted
    #[arg(long, value_name = "NAME", default_value = "train")]
    split: String,
    /// Points farther than this along x or y do not count, nor do boxes farther away, m
    #[arg(long, value_name = "M", default_value_t = 100.0)]
    max_range: f64,
    /// Write the result as JSON, too
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

impl EvalStatisticsArgs {
    /// Counts, prints the table and writes the JSON.
    #[expect(clippy::print_stdout, reason = "results go to stdout")]
    pub fn run(self) -> Result<()> {
        let [a, b] = [Dataset::open(&self.a)?, Dataset::open(&self.b)?];
        let report = compare_statistics(&a, &b, &self.split, self.max_range)?;
        if let Some(path) = &self.json {
            write_json(path, &report)?;
        }
        print!("{report}");
        Ok(())
    }
}
