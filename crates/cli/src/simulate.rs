//! `lidarshift simulate`: a synthetic data set on disk.

use anyhow::{Result, bail};
use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};
use simulate::{FrameCounts, RoadConfig, make_road_dataset};
use std::path::PathBuf;

/// Make a data set: roads with cars, seen by a spinning LiDAR. The same seed gives the same bytes.
///
/// A run that was stopped goes on where it was when it is started again with the same words.
///
/// Examples:
///   lidarshift simulate --out datasets/road
///   lidarshift simulate --frames 100 --seed 7 --out datasets/road-7
#[derive(Args, Debug)]
#[command(verbatim_doc_comment)]
pub struct SimulateArgs {
    /// Folder for the data set: new, empty, or begun with the same words
    #[arg(long, value_name = "DIR", default_value = "datasets/road")]
    out: PathBuf,
    /// Frames of all splits together, in the proportions of the configuration
    #[arg(long, value_name = "N")]
    frames: Option<usize>,
    /// Another seed gives other scenes
    #[arg(long, value_name = "K")]
    seed: Option<u64>,
    /// Numbers of frames, scenes and sensor as TOML; docs/configuration.md lists the keys
    #[arg(long, value_name = "TOML")]
    config: Option<PathBuf>,
}

impl SimulateArgs {
    /// Makes the data set and says what is in it.
    #[expect(clippy::print_stdout, reason = "results go to stdout")]
    pub fn run(self) -> Result<()> {
        let config = self.road_config()?;
        let progress = ProgressBar::new(config.frames.total() as u64)
            .with_style(ProgressStyle::with_template("{bar:30} {pos}/{len} frames, {per_sec}, {eta} left")?);
        let manifest = make_road_dataset(&config, &self.out, &|done, _| progress.set_position(done as u64))?;
        progress.finish_and_clear();
        for (split, _) in config.frames.splits() {
            let counts = manifest.splits[split];
            let points = counts.points / counts.frames;
            println!("{split}: {} frames, {} cars, {points} points a frame", counts.frames, counts.cars);
        }
        eprintln!("data set in {}", self.out.display());
        Ok(())
    }

    fn road_config(&self) -> Result<RoadConfig> {
        let mut config = match &self.config {
            Some(path) => RoadConfig::read(path)?,
            None => RoadConfig::default(),
        };
        config.seed = self.seed.unwrap_or(config.seed);
        if let Some(total) = self.frames {
            config.frames = match FrameCounts::scaled_to(&config.frames, total) {
                Some(frames) => frames,
                None => bail!("--frames {total}: there must be at least 3, one for each split"),
            };
        }
        Ok(config)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn args(frames: Option<usize>, seed: Option<u64>) -> SimulateArgs {
        SimulateArgs { out: "unused".into(), frames, seed, config: None }
    }

    #[test]
    fn words_win_over_the_configuration() {
        let config = args(Some(36), Some(9)).road_config().unwrap();
        assert_eq!((config.frames.total(), config.seed), (36, 9));
        assert_eq!(args(None, None).road_config().unwrap(), RoadConfig::default());
        assert!(args(Some(2), None).road_config().unwrap_err().to_string().contains("--frames 2"));
    }
}
