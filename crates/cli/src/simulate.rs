//! `lidarshift simulate`: simulates data sets and writes them to disk.

use crate::console::escaped;
use crate::json::JsonArgs;
use crate::{errln, out, outln};
use anyhow::Result;
use clap::Args;
use data::Presence as _;
use data::{Dataset, verify_frames, write_atomic};
use indicatif::{ProgressBar, ProgressStyle};
use report::{BirdsEyeOptions, Style, birds_eye_png};
use schemars::JsonSchema;
use serde::Serialize;
use simulate::race::{ConfigFiles, RaceConfig, RaceManifest, make_race_datasets};
use simulate::{RoadConfig, Scenery, make_road_dataset};
use std::path::{Path, PathBuf};

/// Simulate data sets: a race on an oval, once as a stand-in for measured data and once as an ideal simulator would
/// show it, or streets with cars. The same seed gives the same files, byte for byte.
///
/// Run the same command again to resume an interrupted run. Frames whose files were changed are made anew.
///
/// Examples:
///   lidarshift simulate
///   lidarshift simulate --config race_small --out datasets/small
///   lidarshift simulate --config street --frames 100 --seed 7 --out datasets/road-7
#[derive(Args, Debug)]
#[command(verbatim_doc_comment)]
pub struct SimulateArgs {
    /// Scenes to simulate: race, race_small, race_full, race_study, street, or a TOML;
    /// docs/src/reference/configuration.md lists
    /// its keys
    #[arg(long, value_name = "CONFIG", default_value = "race")]
    config: String,
    /// Folder for the data sets: new, empty, or of an interrupted run [default: datasets/NAME]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Number of frames of each data set [default: from the configuration]
    #[arg(long, value_name = "N")]
    frames: Option<usize>,
    /// Random seed of the scenes [default: from the configuration]
    #[arg(long, value_name = "K")]
    seed: Option<u64>,
    /// Only these data sets of a race, separated by commas [default: all]
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    dataset: Vec<String>,
    /// Simulate nothing; compare every file of the frames with its SHA-256 from when it was written
    #[arg(long, conflicts_with = "json")]
    verify: bool,
    #[command(flatten)]
    json: JsonArgs,
}

/// Version of the JSON of a race.
pub(crate) const RACE_MANIFESTS_SCHEMA: &str = "lidarshift/race-manifests/1";

/// The data sets of a race.
#[derive(Serialize, JsonSchema)]
#[schemars(title = "RaceManifests")]
pub(crate) struct RaceManifests<'a> {
    /// `lidarshift/race-manifests/1`.
    schema: &'static str,
    /// `manifest.json` of each data set.
    manifests: &'a [RaceManifest],
}

impl SimulateArgs {
    /// Simulates the data sets and prints their sizes.
    pub fn run(self) -> Result<()> {
        self.json.check([])?;
        match Scenery::find(&self.config, self.frames, self.seed)? {
            scenery if self.verify => self.verify(&scenery),
            Scenery::Street(config) => self.street(&config),
            Scenery::Race(race) => self.race(&race.0, &race.1),
        }
    }

    /// Compares the data sets on disk with their records.
    fn verify(&self, scenery: &Scenery) -> Result<()> {
        let folders: Vec<PathBuf> = match scenery {
            Scenery::Street(_) => vec![self.street_folder()],
            Scenery::Race(race) => {
                let out = self.race_folder(&race.0);
                let wanted = |name: &&String| self.dataset.is_empty() || self.dataset.contains(name);
                race.0.datasets.iter().map(|set| &set.name).filter(wanted).map(|name| out.join(name)).collect()
            }
        };
        for folder in folders {
            outln!("{}: {} frames are as they were written", folder.display(), verify_frames(&folder)?);
        }
        Ok(())
    }

    fn street_folder(&self) -> PathBuf {
        self.out.clone().unwrap_or_else(|| "datasets/road".into())
    }

    fn race_folder(&self, config: &RaceConfig) -> PathBuf {
        self.out.clone().unwrap_or_else(|| Path::new("datasets").join(&config.name))
    }

    fn street(&self, config: &RoadConfig) -> Result<()> {
        let out = self.street_folder();
        let progress = bar()?;
        progress.set_length(config.frames.total() as u64);
        let manifest = make_road_dataset(config, &out, &|done, _| progress.set_position(done as u64))?;
        progress.finish_and_clear();
        self.json.write(&manifest)?;
        for (split, _) in config.frames.splits() {
            let counts = manifest.splits[split];
            let points = counts.points / counts.frames;
            outln!("{split}: {} frames, {} cars, {points} points per frame", counts.frames, counts.cars);
        }
        errln!("data set written to {}", out.display());
        Ok(())
    }

    fn race(&self, config: &RaceConfig, files: &ConfigFiles) -> Result<()> {
        let out = self.race_folder(config);
        let progress = bar()?;
        let show_progress = |name: &str, done: usize, total: usize| {
            progress.set_message(escaped(name).into_owned());
            progress.set_length(total as u64);
            progress.set_position(done as u64);
        };
        let manifests = make_race_datasets(config, files, &out, &self.dataset, &show_progress)?;
        progress.finish_and_clear();
        manifests.iter().try_for_each(|manifest| preview(&out.join(&manifest.name[1])))?;
        self.json.write(&RaceManifests { schema: RACE_MANIFESTS_SCHEMA, manifests: &manifests })?;
        manifests.iter().for_each(|manifest| out!("{}", summary(manifest)));
        errln!("data sets written to {}", out.display());
        Ok(())
    }
}

fn bar() -> Result<ProgressBar> {
    let style = ProgressStyle::with_template("{msg} {bar:30} {pos}/{len} frames, {per_sec}, {eta} left")?;
    Ok(ProgressBar::new(0).with_style(style))
}

/// Writes `preview.png`, a bird's eye view of the first test frame. All data sets of a race show the same frame.
fn preview(folder: &Path) -> Result<()> {
    let picture = folder.join("preview.png");
    if picture.may_be_file() {
        return Ok(());
    }
    let dataset = Dataset::open(folder)?;
    let Some(id) = dataset.ids("test")?.into_iter().next() else { return Ok(()) };
    let frame = dataset.load(&id)?;
    let boxes: Vec<_> = frame.objects.iter().map(|o| (o.bbox, Style::GroundTruth)).collect();
    match birds_eye_png(&frame.cloud, &boxes, &BirdsEyeOptions::default()) {
        Ok(bytes) => Ok(write_atomic(&picture, &bytes)?),
        Err(error) => {
            errln!("warning: no picture of frame {id}: {error}");
            Ok(())
        }
    }
}

/// One line per split; for data sets with auto-labels, also the rms errors of the labels.
fn summary(manifest: &RaceManifest) -> String {
    let name = &manifest.name[1];
    let mut text = String::new();
    for (split, counts) in &manifest.splits {
        let points = counts.points / counts.frames.max(1);
        text += &format!("{name} {split}: {} frames, {} cars, {points} points per frame\n", counts.frames, counts.cars);
    }
    for error in manifest.label_errors.iter().filter(|e| e.labels > 0) {
        let [along, across, up] = error.rms_m;
        text += &format!(
            "{name}, {} labels at {:.0} to {:.0} m: rms error {along:.2} m longitudinal, {across:.2} m lateral, {up:.2} m vertical\n",
            error.labels, error.range_m[0], error.range_m[1]
        );
    }
    text
}
