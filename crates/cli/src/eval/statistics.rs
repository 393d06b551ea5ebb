//! `lidarshift eval statistics`: point and box statistics of two data sets with the same frames.

use crate::json::JsonArgs;
use crate::out;
use anyhow::Result;
use clap::Args;
use data::Dataset;
use eval::compare_statistics;
use std::path::PathBuf;

/// Compare the numbers of points and boxes of two data sets with the same frames (the paper's Table I).
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
    /// Second data set, with the same frame ids
    #[arg(value_name = "B")]
    b: PathBuf,
    /// Split of the first data set that gives the frames
    #[arg(long, value_name = "NAME", default_value = "train")]
    split: String,
    /// Ignore points with a larger |x| or |y|, and boxes at a larger distance, m
    #[arg(long, value_name = "M", default_value_t = 100.0)]
    max_range: f64,
    #[command(flatten)]
    json: JsonArgs,
}

impl EvalStatisticsArgs {
    /// Counts, prints the table and writes the JSON.
    pub fn run(self) -> Result<()> {
        self.json.check([])?;
        let [a, b] = [Dataset::open(&self.a)?, Dataset::open(&self.b)?];
        let report = compare_statistics(&a, &b, &self.split, self.max_range)?;
        self.json.write(&report)?;
        out!("{report}");
        Ok(())
    }
}
