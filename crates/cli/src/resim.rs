//! `lidarshift resim`: the sensor model on a finished data set.

use anyhow::{Context, Result};
use clap::Args;
use data::Dataset;
use indicatif::{ProgressBar, ProgressStyle};
use simulate::Rig;
use simulate::effects::EffectList;
use simulate::resim::Resim;
use std::path::PathBuf;

/// Make a data set from another one with physical effects on top: noise, dropout, offsets, ... Effects that need rays to be cast anew are
/// refused by name.
///
/// A run that was stopped goes on where it was when it is started again with the same words.
///
/// Examples:
///   lidarshift resim --effects configs/simulate/sim_noise.toml datasets/race/sim --out datasets/noisy
///   lidarshift resim --effects my-effects.toml --rig configs/sensors/hdl64e.toml --seed 3 /data/kitti --out datasets/kitti-rain
#[derive(Args, Debug)]
#[command(verbatim_doc_comment)]
pub struct ResimArgs {
    /// Data set: its folder or its TOML
    #[arg(value_name = "DATASET")]
    dataset: PathBuf,
    /// TOML with the list of effects; docs/src/reference/effects.md has them all
    #[arg(long, value_name = "TOML")]
    effects: PathBuf,
    /// Folder for the data set: new, empty, or begun with the same words
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// TOML of the sensors [default: those of the data set's TOML, or one at the origin of the clouds]
    #[arg(long, value_name = "TOML")]
    rig: Option<PathBuf>,
    /// Another seed gives other noise
    #[arg(long, value_name = "K", default_value_t = 0)]
    seed: u64,
}

impl ResimArgs {
    /// Makes the data set and says what is in it.
    #[expect(clippy::print_stdout, reason = "results go to stdout")]
    pub fn run(self) -> Result<()> {
        let dataset = Dataset::open(&self.dataset)?;
        let effects = EffectList::read(&self.effects)?;
        let rig = self.rig.as_deref().map(Rig::read).transpose()?;
        let progress = ProgressBar::new(0)
            .with_style(ProgressStyle::with_template("{bar:30} {pos}/{len} frames, {per_sec}, {eta} left")?);
        let resim = Resim { dataset: &dataset, effects: &effects, rig, seed: self.seed };
        let made = resim.make(&self.out, &|done, total| {
            progress.set_length(total as u64);
            progress.set_position(done as u64);
        });
        let manifest = made.with_context(|| format!("{} on {}", self.effects.display(), self.dataset.display()))?;
        progress.finish_and_clear();
        let [before, after] = manifest.points.map(|n| n / manifest.frames.max(1));
        println!("{} frames, {after} points a frame ({before} before)", manifest.frames);
        eprintln!("data set in {}", self.out.display());
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use simulate::{FrameCounts, RoadConfig, make_road_dataset};

    #[test]
    fn what_does_not_fit_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let (street, effects) = (folder.path().join("street"), folder.path().join("e.toml"));
        let config = RoadConfig { frames: FrameCounts { train: 1, val: 1, test: 1 }, ..RoadConfig::default() };
        make_road_dataset(&config, &street, &|_, _| ()).unwrap();
        let args = |out: &str| ResimArgs {
            dataset: street.clone(),
            effects: effects.clone(),
            out: folder.path().join(out),
            rig: None,
            seed: 1,
        };
        std::fs::write(&effects, "[[effect]]\nkind = \"range_noise\"\n").unwrap();
        args("noisy").run().unwrap();
        assert_eq!(Dataset::open(&folder.path().join("noisy")).unwrap().ids("test").unwrap(), ["test_000000"]);
        std::fs::write(&effects, "[[effect]]\nkind = \"ghosts\"\n").unwrap();
        let error = format!("{:#}", args("ghosts").run().unwrap_err());
        assert!(error.contains("e.toml on") && error.contains("effect[0]: ghosts"), "{error}");
    }
}
