//! `lidarshift eval distances`: distances between the point clouds of two data sets.

use crate::json::JsonArgs;
use crate::out;
use anyhow::{Result, bail};
use clap::{Args, ValueEnum};
use data::Dataset;
use eval::distance::{Compared, DistanceOptions, Distances};
use models::find_detector;
use std::path::PathBuf;
use study::clouds::{Loader, distances_of};

/// Chamfer, earth mover's and sliced Wasserstein distances between two data sets with the same frames: for whole
/// clouds, for the targets only and by range. Each distance comes with its floor, and the Chamfer distance with the
/// share of each region of the scene.
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
    /// Second data set, with the same frame ids
    #[arg(value_name = "B")]
    b: PathBuf,
    /// Split whose frames are compared
    #[arg(long, value_name = "NAME", default_value = "train")]
    split: String,
    /// Maximum number of frames, spread evenly over the split [default: all]
    #[arg(long, value_name = "N")]
    frames: Option<usize>,
    /// Which clouds are compared
    #[arg(long, value_enum, default_value = "raw")]
    compared: What,
    /// Detector whose training loader is used, for --compared loader and augmented
    #[arg(long, value_name = "NAME|TOML")]
    detector: Option<String>,
    #[command(flatten)]
    json: JsonArgs,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum What {
    /// The clouds as stored in the data sets
    Raw,
    /// The output of the training loader without augmentation
    Loader,
    /// The output of the training loader with augmentation
    Augmented,
}

impl EvalDistancesArgs {
    /// Prints the table.
    ///
    /// # Errors
    /// Frames that are not in both data sets or cannot be read.
    pub fn run(self) -> Result<()> {
        self.json.check([])?;
        let [a, b] = [Dataset::open(&self.a)?, Dataset::open(&self.b)?];
        let compared = match self.compared {
            What::Raw => Compared::Raw,
            What::Loader => Compared::Loader,
            What::Augmented => Compared::Augmented,
        };
        let loader = match &self.detector {
            _ if compared == Compared::Raw => None,
            Some(name) => Some(Loader::of(&find_detector(name)?)),
            None => bail!("--compared {compared} needs --detector, the detector whose training loader is used"),
        };
        let options = DistanceOptions { compared, ..DistanceOptions::default() };
        let names = [a.config.name.as_str(), &b.config.name];
        let found = distances_of(names, [&a, &b], &self.split, self.frames, loader.as_ref(), &options)?;
        self.json.write(&found)?;
        out!("{}", table(&found));
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
