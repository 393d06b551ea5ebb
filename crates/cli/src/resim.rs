//! `lidarshift resim`: applies sensor effects to an existing data set.

use crate::json::JsonArgs;
use crate::{errln, outln};
use anyhow::{Context, Result};
use clap::Args;
use data::{Dataset, verify_frames};
use indicatif::{ProgressBar, ProgressStyle};
use sensor::{EffectList, Rig};
use simulate::resim::Resim;
use std::path::PathBuf;

/// Apply sensor effects to an existing data set and write the result as a new one: noise, dropout, offsets, ... An
/// effect that needs new ray casting, or something that the data set does not tell, is an error.
///
/// Run the same command again to resume an interrupted run. Frames whose files or sources were changed are made anew.
///
/// Examples:
///   lidarshift resim --effects configs/simulate/sim_noise.toml datasets/race/sim --out datasets/noisy
///   lidarshift resim --effects my-effects.toml --sensor hdl64e.toml --seed 3 /data/kitti --out datasets/kitti-noisy
#[derive(Args, Debug)]
#[command(verbatim_doc_comment)]
pub struct ResimArgs {
    /// Data set: its folder or its TOML
    #[arg(value_name = "DATASET")]
    dataset: PathBuf,
    /// TOML with the list of effects; see docs/src/reference/effects.md
    #[arg(long, value_name = "TOML")]
    effects: PathBuf,
    /// Folder for the new data set: new, empty, or of an interrupted run
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// TOML with the poses of the sensors [default: from the data set's TOML, else one sensor at the origin of the
    /// clouds]
    #[arg(long, alias = "rig", value_name = "TOML")]
    sensor: Option<PathBuf>,
    /// Random seed
    #[arg(long, value_name = "K", default_value_t = 0)]
    seed: u64,
    /// Leave out effects that cannot be applied to this data set, and list them
    #[arg(long)]
    skip_inapplicable: bool,
    /// Write nothing; compare every file of the frames in --out with its SHA-256 from when it was written
    #[arg(long, conflicts_with = "json")]
    verify: bool,
    #[command(flatten)]
    json: JsonArgs,
}

impl ResimArgs {
    /// Writes the data set and prints its size.
    pub fn run(self) -> Result<()> {
        if self.verify {
            outln!("{}: {} frames are as they were written", self.out.display(), verify_frames(&self.out)?);
            return Ok(());
        }
        let dataset = Dataset::open(&self.dataset)?;
        dataset.refuse_own_folder(&self.out)?;
        self.json.check([&*self.effects].into_iter().chain(self.sensor.as_deref()))?;
        let mut effects = EffectList::read(&self.effects)?;
        if effects.effects.is_empty() {
            errln!("note: {} has no effect: the clouds are copied", self.effects.display());
        }
        let rig = self.sensor.as_deref().map(Rig::read).transpose()?;
        let progress = ProgressBar::new(0)
            .with_style(ProgressStyle::with_template("{bar:30} {pos}/{len} frames, {per_sec}, {eta} left")?);
        if self.skip_inapplicable {
            let refused =
                Resim { dataset: &dataset, effects: &effects, rig: rig.clone(), seed: self.seed }.refused()?;
            for refusal in &refused {
                outln!("left out: effect[{}]: {} {}", refusal.index, refusal.kind, refusal.why);
            }
            effects = effects.without(&refused);
        }
        let resim = Resim { dataset: &dataset, effects: &effects, rig, seed: self.seed };
        let made = resim.make(&self.out, &|done, total| {
            progress.set_length(total as u64);
            progress.set_position(done as u64);
        });
        let manifest = made.with_context(|| format!("{} on {}", self.effects.display(), self.dataset.display()))?;
        progress.finish_and_clear();
        self.json.write(&manifest)?;
        let [before, after] = manifest.points.map(|n| n / manifest.frames.max(1));
        outln!("{} frames, {after} points per frame ({before} before)", manifest.frames);
        errln!("data set written to {}", self.out.display());
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use simulate::{FrameCounts, RoadConfig, make_road_dataset};

    #[test]
    fn effects_that_cannot_be_applied_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let (street, effects) = (folder.path().join("street"), folder.path().join("e.toml"));
        let config = RoadConfig { frames: FrameCounts { train: 1, val: 1, test: 1 }, ..RoadConfig::default() };
        make_road_dataset(&config, &street, &|_, _| ()).unwrap();
        let args = |out: &str| ResimArgs {
            dataset: street.clone(),
            effects: effects.clone(),
            out: folder.path().join(out),
            sensor: None,
            seed: 1,
            skip_inapplicable: false,
            verify: false,
            json: JsonArgs::default(),
        };
        std::fs::write(&effects, "[[effect]]\nkind = \"range_noise\"\nstd_m = 0.02\n").unwrap();
        args("noisy").run().unwrap();
        assert_eq!(Dataset::open(&folder.path().join("noisy")).unwrap().ids("test").unwrap(), ["test_000000"]);
        std::fs::write(&effects, "[[effect]]\nkind = \"ghosts\"\nprobability = 0.02\n").unwrap();
        let error = format!("{:#}", args("ghosts").run().unwrap_err());
        assert!(error.contains("e.toml on") && error.contains("effect[0]: ghosts"), "{error}");
        ResimArgs { skip_inapplicable: true, ..args("copied") }.run().unwrap();
        let cloud = |root: &str| std::fs::read(folder.path().join(root).join("velodyne/test_000000.bin")).unwrap();
        assert!(cloud("copied") == cloud("street"));
    }
}
