//! `lidarshift eval distances`: how far the clouds of two data sets are from each other.

use anyhow::{Result, bail};
use clap::{Args, ValueEnum};
use data::{Dataset, write_json};
use eval::distance::{Compared, DistanceOptions, Distances};
use models::find_detector;
use std::path::PathBuf;
use study::clouds::{Loader, distances_of};

/// Chamfer, earth mover's and sliced Wasserstein distances of two data sets of the same frames, each with its floor: the whole clouds, the
/// targets alone, by distance from the sensor; and which part of the Chamfer distance comes from where.
///
/// Examples:
///   lidarshift eval distances datasets/race/measured datasets/race/sim --frames 20
///   lidarshift eval distances A B --compared augmented --detector pointpillars_race_small --json distances.json
#[derive(Args, Debug)]
#[command(verbatim_doc_comment)]
pub struct EvalDistancesArgs {
    /// First data set: its folder or its TOML
    #[arg(value_name = "A")]
    a: PathBuf,
    /// Second data set, with the same frames under the same names
    #[arg(value_name = "B")]
    b: PathBuf,
    /// Split whose frames are compared
    #[arg(long, value_name = "NAME", default_value = "train")]
    split: String,
    /// At most so many frames, evenly over the split [default: all]
    #[arg(long, value_name = "N")]
    frames: Option<usize>,
    /// What is compared
    #[arg(long, value_enum, default_value = "raw")]
    compared: What,
    /// Detector whose training loader it is
    #[arg(long, value_name = "NAME|TOML")]
    detector: Option<String>,
    /// Write the result as JSON, too
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum What {
    /// The clouds as the data sets hold them
    Raw,
    /// What the training loader gives before augmentation
    Loader,
    /// What the training loader gives after augmentation
    Augmented,
}

impl EvalDistancesArgs {
    /// Prints the table.
    ///
    /// # Errors
    /// Frames that do not pair or cannot be read.
    #[expect(clippy::print_stdout, reason = "results go to stdout")]
    pub fn run(self) -> Result<()> {
        let [a, b] = [Dataset::open(&self.a)?, Dataset::open(&self.b)?];
        let compared = match self.compared {
            What::Raw => Compared::Raw,
            What::Loader => Compared::Loader,
            What::Augmented => Compared::Augmented,
        };
        let loader = match &self.detector {
            _ if compared == Compared::Raw => None,
            Some(name) => Some(Loader::of(&find_detector(name)?)),
            None => bail!("--compared {compared}: name the --detector whose training loader it is"),
        };
        let options = DistanceOptions { compared, ..DistanceOptions::default() };
        let names = [a.config.name.as_str(), &b.config.name];
        let found = distances_of(names, [&a, &b], &self.split, self.frames, loader.as_ref(), &options)?;
        if let Some(path) = &self.json {
            write_json(path, &found)?;
        }
        print!("{}", table(&found));
        Ok(())
    }
}

fn table(found: &Distances) -> String {
    let mut text = format!(
        "A: {}, B: {}, {} frames, {}\n{:<20} {:<30} {:>12} {:>25} {:>12}\n",
        found.a, found.b, found.frames, found.options.compared, "part", "measure", "mean", "interval", "floor"
    );
    let number = |value: Option<f64>| value.map_or("-".into(), |v| format!("{v:.4}"));
    for row in &found.rows {
        let interval = row.interval.map_or("-".into(), |i| format!("{:.4} to {:.4}", i.low, i.high));
        let (part, measure) = (row.part.to_string(), row.measure.to_string());
        text +=
            &format!("{part:<20} {measure:<30} {:>12} {interval:>25} {:>12}\n", number(row.mean), number(row.floor));
    }
    for region in &found.regions {
        text += &format!("{:>5.1} % of the Chamfer sum: {}\n", 100.0 * region.share, region.region);
    }
    text
}
