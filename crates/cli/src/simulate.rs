//! `lidarshift simulate`: synthetic data sets on disk.

use anyhow::Result;
use clap::Args;
use data::{Dataset, write_atomic};
use indicatif::{ProgressBar, ProgressStyle};
use report::{BirdsEyeOptions, Style, birds_eye_png};
use simulate::race::{ConfigFiles, RaceConfig, RaceManifest, make_race_datasets};
use simulate::{RoadConfig, Scenery, make_road_dataset};
use std::path::{Path, PathBuf};

/// Make data sets: a race on an oval as it stands for the road and as simulators show it, or streets with cars. The same seed gives the
/// same bytes.
///
/// A run that was stopped goes on where it was when it is started again with the same words.
///
/// Examples:
///   lidarshift simulate
///   lidarshift simulate --config race_small --out datasets/small
///   lidarshift simulate --config street --frames 100 --seed 7 --out datasets/road-7
#[derive(Args, Debug)]
#[command(verbatim_doc_comment)]
pub struct SimulateArgs {
    /// What to make: race, race_small, race_full, street, or a TOML; docs/src/reference/configuration.md lists the keys
    #[arg(long, value_name = "CONFIG", default_value = "race")]
    config: String,
    /// Folder for the data sets: new, empty, or begun with the same words [default: datasets/NAME]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Frames of each data set
    #[arg(long, value_name = "N")]
    frames: Option<usize>,
    /// Another seed gives other scenes
    #[arg(long, value_name = "K")]
    seed: Option<u64>,
    /// Of a race only these data sets, with commas between them
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    dataset: Vec<String>,
}

impl SimulateArgs {
    /// Makes the data sets and says what is in them.
    pub fn run(self) -> Result<()> {
        match Scenery::find(&self.config, self.frames, self.seed)? {
            Scenery::Street(config) => self.street(&config),
            Scenery::Race(race) => self.race(&race.0, &race.1),
        }
    }

    #[expect(clippy::print_stdout, reason = "results go to stdout")]
    fn street(&self, config: &RoadConfig) -> Result<()> {
        let out = self.out.clone().unwrap_or_else(|| "datasets/road".into());
        let progress = bar()?;
        progress.set_length(config.frames.total() as u64);
        let manifest = make_road_dataset(config, &out, &|done, _| progress.set_position(done as u64))?;
        progress.finish_and_clear();
        for (split, _) in config.frames.splits() {
            let counts = manifest.splits[split];
            let points = counts.points / counts.frames;
            println!("{split}: {} frames, {} cars, {points} points a frame", counts.frames, counts.cars);
        }
        eprintln!("data set in {}", out.display());
        Ok(())
    }

    #[expect(clippy::print_stdout, reason = "results go to stdout")]
    fn race(&self, config: &RaceConfig, files: &ConfigFiles) -> Result<()> {
        let out = self.out.clone().unwrap_or_else(|| Path::new("datasets").join(&config.name));
        let progress = bar()?;
        let hear = |name: &str, done: usize, total: usize| {
            progress.set_message(name.to_string());
            progress.set_length(total as u64);
            progress.set_position(done as u64);
        };
        let manifests = make_race_datasets(config, files, &out, &self.dataset, &hear)?;
        progress.finish_and_clear();
        manifests.iter().for_each(|manifest| print!("{}", summary(manifest)));
        manifests.iter().try_for_each(|manifest| preview(&out.join(&manifest.name[1])))?;
        eprintln!("data sets in {}", out.display());
        Ok(())
    }
}

fn bar() -> Result<ProgressBar> {
    let style = ProgressStyle::with_template("{msg} {bar:30} {pos}/{len} frames, {per_sec}, {eta} left")?;
    Ok(ProgressBar::new(0).with_style(style))
}

/// The first frame of the test split from above: `preview.png`, the same frame in all data sets of a race.
fn preview(folder: &Path) -> Result<()> {
    let picture = folder.join("preview.png");
    if picture.is_file() {
        return Ok(());
    }
    let dataset = Dataset::open(folder)?;
    let Some(id) = dataset.ids("test")?.into_iter().next() else { return Ok(()) };
    let frame = dataset.load(&id)?;
    let boxes: Vec<_> = frame.objects.iter().map(|o| (o.bbox, Style::GroundTruth)).collect();
    let bytes = birds_eye_png(&frame.cloud, &boxes, &BirdsEyeOptions::default())?;
    Ok(write_atomic(&picture, &bytes)?)
}

/// A line a split, and how far labels are off where they are made as on the road.
fn summary(manifest: &RaceManifest) -> String {
    let name = &manifest.name[1];
    let mut text = String::new();
    for (split, counts) in &manifest.splits {
        let points = counts.points / counts.frames.max(1);
        text += &format!("{name} {split}: {} frames, {} cars, {points} points a frame\n", counts.frames, counts.cars);
    }
    for error in manifest.label_errors.iter().filter(|e| e.labels > 0) {
        let [along, across, up] = error.rms_m;
        text += &format!(
            "{name} labels at {:.0} to {:.0} m: off by {along:.2} m along, {across:.2} m across, {up:.2} m up (rms of {})\n",
            error.range_m[0], error.range_m[1], error.labels
        );
    }
    text
}
