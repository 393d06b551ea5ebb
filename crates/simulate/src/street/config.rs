//! TOML configuration of a synthetic street data set.

use crate::SimulateError;
use crate::street::scene::SceneConfig;
use crate::street::sensor::SensorConfig;
use data::KeyError;
use data::toml_text::{read_toml, wrong};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// A synthetic street data set. All keys are optional.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RoadConfig {
    /// Random seed of the scenes.
    pub seed: u64,
    /// Number of frames per split. Every frame is an independent scene.
    pub frames: FrameCounts,
    /// The road and the objects on it.
    pub scene: SceneConfig,
    /// The LiDAR.
    pub sensor: SensorConfig,
}

/// Number of frames per split.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct FrameCounts {
    /// Training frames.
    pub train: usize,
    /// Validation frames, used to choose the best checkpoint.
    pub val: usize,
    /// Test frames.
    pub test: usize,
}

impl Default for FrameCounts {
    fn default() -> Self {
        FrameCounts { train: 240, val: 40, test: 80 }
    }
}

impl FrameCounts {
    /// Splits and their sizes, in the order of generation.
    pub fn splits(&self) -> [(&'static str, usize); 3] {
        [("train", self.train), ("val", self.val), ("test", self.test)]
    }

    /// Total number of frames.
    pub fn total(&self) -> usize {
        self.train + self.val + self.test
    }

    /// `total` frames in the same proportions, at least one per split; `None` for fewer than three frames.
    pub fn scaled_to(&self, total: usize) -> Option<FrameCounts> {
        if total < 3 {
            return None;
        }
        let share = |n: usize| (total as f64 * n as f64 / self.total().max(1) as f64).round() as usize;
        let val = share(self.val).clamp(1, total - 2);
        let test = share(self.test).clamp(1, total - val - 1);
        Some(FrameCounts { train: total - val - test, val, test })
    }
}

impl RoadConfig {
    /// Reads a TOML file; missing keys keep their defaults.
    pub fn read(path: &Path) -> Result<Self, SimulateError> {
        Ok(read_toml(path, RoadConfig::check)?)
    }

    /// Checks the configuration; errors name the key.
    pub fn check(&self) -> Result<(), KeyError> {
        for (field, n) in
            [("frames.train", self.frames.train), ("frames.val", self.frames.val), ("frames.test", self.frames.test)]
        {
            if !(1..=1_000_000).contains(&n) {
                return Err(wrong(field, format!("{n} is not between 1 and 1,000,000")));
            }
        }
        self.scene.check()?;
        self.sensor.check()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_stand_and_come_back_from_toml() {
        let config = RoadConfig::default();
        config.check().unwrap();
        let text = toml::to_string(&config).unwrap();
        assert_eq!(toml::from_str::<RoadConfig>(&text).unwrap(), config);
        assert_eq!(toml::from_str::<RoadConfig>("").unwrap(), config);
    }

    #[test]
    fn wrong_keys_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("road.toml");
        for (text, want) in [
            ("seed = 1\ncolour = 2\n", "road.toml:2: unknown field `colour`"),
            ("[frames]\ntrain = \"many\"\n", "road.toml:2: frames.train: invalid type"),
            ("[frames]\nval = 0\n", "frames.val: 0 is not between"),
            ("[sensor]\nrange_noise_m = -1.0\n", "sensor.range_noise_m: -1 is not between"),
            ("[sensor]\nazimuth_step_deg = nan\n", "sensor.azimuth_step_deg"),
            ("[sensor]\nbeam_blocks = []\n", "sensor.beam_blocks"),
            ("[scene]\ncars = [5, 2]\n", "scene.cars"),
        ] {
            std::fs::write(&path, text).unwrap();
            let error = RoadConfig::read(&path).unwrap_err().to_string();
            assert!(error.contains(want), "{text}: {error}");
        }
    }

    #[test]
    fn few_frames_still_fill_every_split() {
        let counts = FrameCounts::default();
        assert_eq!(counts.scaled_to(2), None);
        for total in [3, 4, 10, 360, 1001] {
            let scaled = counts.scaled_to(total).unwrap();
            assert_eq!(scaled.total(), total);
            assert!(scaled.splits().iter().all(|(_, n)| *n >= 1), "{scaled:?}");
        }
        assert_eq!(counts.scaled_to(360), Some(counts));
    }
}
