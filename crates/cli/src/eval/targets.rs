//! `lidarshift eval targets`: statistics of the labelled targets of data sets.

use crate::json::JsonArgs;
use crate::{out, outln};
use anyhow::{Result, bail};
use clap::Args;
use data::Dataset;
use eval::targets::{Spread, TargetOptions, Targets, targets};
use report::StudyReport;
use std::path::PathBuf;

/// Labelled targets of one or more data sets: their number, positions and numbers of points, and their points
/// accumulated in the box frame, by range. --out also writes figures.
///
/// Examples:
///   lidarshift eval targets datasets/race/measured datasets/race/sim
///   lidarshift eval targets my-data --split test --class Pedestrian --out targets
#[derive(Args, Debug)]
#[command(verbatim_doc_comment)]
pub struct EvalTargetsArgs {
    /// Data sets: folders or TOMLs
    #[arg(value_name = "DATASET", required = true)]
    datasets: Vec<PathBuf>,
    /// Split that gives the frames
    #[arg(long, value_name = "NAME", default_value = "train")]
    split: String,
    /// Class of the targets
    #[arg(long, value_name = "NAME", default_value = "Car")]
    class: String,
    /// Folder for report.html, figures and tables
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten)]
    json: JsonArgs,
}

impl EvalTargetsArgs {
    /// Prints the statistics.
    ///
    /// # Errors
    /// Frames that cannot be read; no target in any data set.
    pub fn run(self) -> Result<()> {
        self.json.check([])?;
        let options = TargetOptions { class: self.class.clone(), ..TargetOptions::default() };
        let mut all = Vec::new();
        for path in &self.datasets {
            let set = Dataset::open(path)?;
            let ids = set.ids(&self.split)?;
            all.push(targets(&set.config.name, &ids, |id| set.load(id), &options)?);
        }
        if all.iter().all(|found| found.targets.is_empty()) {
            bail!("no frame of the split {} has a {} within {} m", self.split, self.class, options.max_range_m);
        }
        self.json.write(&all)?;
        let tables: Vec<String> = all.iter().map(table).collect();
        let mut figures = None;
        if let Some(out) = &self.out {
            let names: Vec<&str> = all.iter().map(|found| found.dataset.as_str()).collect();
            let title = format!("Targets of {}", names.join(", "));
            let files = StudyReport { title, targets: all, ..StudyReport::default() }.write(out)?;
            figures = Some(files.page);
        }
        tables.iter().for_each(|table| out!("{table}"));
        if let Some(page) = figures {
            outln!("figures: {}", page.display());
        }
        Ok(())
    }
}

fn table(found: &Targets) -> String {
    let mut text = format!("{}: {} frames, {} targets\n", found.dataset, found.frames, found.targets.len());
    let spread = |s: &Spread| match (s.mean, s.min, s.max) {
        (Some(mean), Some(min), Some(max)) => format!("{mean:.1} ({min:.1} to {max:.1})"),
        _ => "-".into(),
    };
    text += &format!("  points per cloud   {}\n", spread(&found.points_per_cloud));
    text += &format!("  points per target  {}\n", spread(&found.points_per_target));
    if let Some([length, width, height]) = found.mean_size_m {
        text += &format!("  mean size          {length:.2} x {width:.2} x {height:.2} m\n");
    }
    for section in &found.sections {
        text += &format!(
            "  {:<18} {} targets, {} points\n",
            section.section.to_string(),
            section.targets,
            section.n_points
        );
    }
    text
}
