//! `lidarshift convert`: a data set in another format.

use crate::json::JsonArgs;
use crate::{errln, outln};
use anyhow::{Context, Result};
use clap::{Args, ValueEnum};
use data::convert::{Conversion, Format, SHARD_FRAMES};
use data::{Dataset, verify_frames};
use indicatif::{ProgressBar, ProgressStyle};
use std::path::PathBuf;

/// Write a data set in another format. All layouts that are read can be converted. What is written is a data set again.
///
/// Run the same command again to resume an interrupted run. Frames whose files or sources were changed are made anew.
///
/// Examples:
///   lidarshift convert drive.mcap --to kitti --out datasets/drive
///   lidarshift convert datasets/race/measured --to mcap --out datasets/measured-mcap
///   lidarshift convert /data/million --to shards --out /data/million-shards
#[derive(Args, Debug)]
#[command(verbatim_doc_comment)]
pub struct ConvertArgs {
    /// Data set: its folder, its TOML, or an MCAP file
    #[arg(value_name = "DATASET")]
    dataset: PathBuf,
    /// The format
    #[arg(long, value_name = "FORMAT")]
    to: Target,
    /// Folder for the new data set: new, empty, or of an interrupted run
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Frames of a shard, for --to shards
    #[arg(long, value_name = "N", default_value_t = SHARD_FRAMES, value_parser = at_least_one)]
    shard_frames: usize,
    /// Write nothing; compare every file of the frames in --out with its SHA-256 from when it was written
    #[arg(long, conflicts_with = "json")]
    verify: bool,
    #[command(flatten)]
    json: JsonArgs,
}

/// The formats, as words of the command line.
#[derive(Clone, Copy, Debug, ValueEnum)]
#[value(rename_all = "snake_case")]
enum Target {
    /// KITTI's folders: velodyne/*.bin, label_2/*.txt
    Kitti,
    /// S2R-DAD's folders: data/pcl/*.pcd, data/label/*.txt
    Pcd,
    /// OpenPCDet's custom data: points/*.npy, labels/*.txt
    #[value(name = "open_pcdet")]
    OpenPcdet,
    /// CARLA's PLY, y to the right, and label/*.txt
    Carla,
    /// One MCAP file of ROS 2: PointCloud2, poses on /tf, boxes as markers
    Mcap,
    /// Tar files of many frames each, for data sets of many frames: shards/*.tar
    Shards,
}

fn at_least_one(text: &str) -> Result<usize, String> {
    text.parse().ok().filter(|n| *n > 0).ok_or_else(|| "give a whole number above 0".into())
}

impl ConvertArgs {
    /// Writes the data set and prints its size.
    pub fn run(self) -> Result<()> {
        if self.verify {
            outln!("{}: {} records are as they were written", self.out.display(), verify_frames(&self.out)?);
            return Ok(());
        }
        let dataset = Dataset::open(&self.dataset)?;
        dataset.refuse_own_folder(&self.out)?;
        self.json.check([])?;
        let to = match self.to {
            Target::Kitti => Format::Kitti,
            Target::Pcd => Format::Pcd,
            Target::OpenPcdet => Format::OpenPcdet,
            Target::Carla => Format::Carla,
            Target::Mcap => Format::Mcap,
            Target::Shards => Format::Shards,
        };
        let progress = ProgressBar::new(0)
            .with_style(ProgressStyle::with_template("{bar:30} {pos}/{len} frames, {per_sec}, {eta} left")?);
        let made =
            Conversion { dataset: &dataset, to, shard_frames: self.shard_frames }.make(&self.out, &|done, total| {
                progress.set_length(total as u64);
                progress.set_position(done as u64);
            });
        let manifest = made.with_context(|| format!("converting {}", self.dataset.display()))?;
        progress.finish_and_clear();
        self.json.write(&manifest)?;
        outln!("{} frames, {} points, {} labels", manifest.frames, manifest.points, manifest.labels);
        errln!("data set written to {}", self.out.display());
        Ok(())
    }
}
