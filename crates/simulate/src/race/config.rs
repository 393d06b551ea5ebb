//! TOML configuration of a race's data sets.

use crate::SimulateError;
use crate::auto_label::AutoLabel;
use crate::mesh::MeshFile;
use crate::race::files::ConfigFiles;
use crate::race::frames::split_sizes;
use crate::scenario::{RaceModel, RunFiles};
use data::KeyError;
use data::Layout;
use data::toml_text::{parse_toml, within, wrong};
use schemars::JsonSchema;
use sensor::effects::EffectList;
use sensor::material::Material;
use sensor::rig::Rig;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// A race and its data sets. Paths are relative to the file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RaceConfig {
    /// Folder name of the data sets, and the first part of their names.
    pub name: String,
    /// Random seed of the race and of the noise.
    #[serde(default)]
    pub seed: u64,
    /// The sensor rig file.
    pub rig: PathBuf,
    /// Scale of the sensors' rows and columns relative to the rig.
    #[serde(default = "one")]
    pub resolution: f64,
    /// Number of frames kept, evenly spaced over all runs.
    pub frames: usize,
    /// How frames are assigned to train, val and test.
    #[serde(default)]
    pub split: SplitKind,
    /// Proportions of train, val and test, each above 0.
    #[serde(default = "four_to_one")]
    pub split_shares: [usize; 3],
    /// Points with |x| or |y| above this are cropped, m.
    #[serde(default = "hundred")]
    pub crop_m: f64,
    /// Cars whose centre is farther away on the ground plane are not labelled, m.
    #[serde(default = "hundred")]
    pub label_range_m: f64,
    /// Cars with fewer returns in a simulation without effects, due to occlusion or because no shot hits them, are not
    /// labelled.
    #[serde(default = "five")]
    pub label_points: usize,
    /// Class name of the cars in the labels.
    #[serde(default = "car")]
    pub class: String,
    /// File layout of a data set folder.
    #[serde(default)]
    pub layout: Layout,
    /// Write per-point attributes next to the clouds.
    #[serde(default)]
    pub attributes: bool,
    /// The track.
    #[serde(default)]
    pub track: TrackConfig,
    /// The generated race; not used if `runs` is given.
    #[serde(default)]
    pub race: RaceModel,
    /// Recorded runs.
    #[serde(default, rename = "run")]
    pub runs: Vec<RunFiles>,
    /// Car mesh in the car frame; default: the built-in racing car.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub car: Option<MeshFile>,
    /// Materials that are changed or added.
    #[serde(default)]
    pub materials: BTreeMap<String, Material>,
    /// The data sets, in the order in which they are generated.
    #[serde(default, rename = "dataset")]
    pub datasets: Vec<SetConfig>,
}

/// The track and its surroundings.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct TrackConfig {
    /// CSV file of the centre line; default: an oval modelled on the Las Vegas Motor Speedway.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub file: Option<PathBuf>,
    /// Random seed of the roadside objects.
    pub seed: u64,
}

/// How frames are assigned to train, val and test.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum SplitKind {
    /// In each run, consecutive blocks, with unused frames between them if there are more frames than are kept.
    #[default]
    Blocks,
    /// Each frame at random: test frames can be neighbours of training frames.
    Random,
}

/// A data set; all data sets of a race have the same frames.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SetConfig {
    /// Folder name.
    pub name: String,
    /// Effects file; default: no effects.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub effects: Option<PathBuf>,
    /// Another data set, listed before this one, to which the effects are added.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub from: Option<String>,
    /// Another data set, listed before this one, whose range distribution is matched by dropout after all other
    /// effects.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub matched_to: Option<String>,
    /// Another data set, listed before this one, whose effects on beams and scans are added: its sensor, without its
    /// scene and its labels.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sensor_of: Option<String>,
    /// Make labels as from road recordings; default: exact labels.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub auto_label: Option<AutoLabel>,
    /// Do not write the effects to the data set folder: for a data set that replaces road data.
    #[serde(default)]
    pub hidden: bool,
}

fn one() -> f64 {
    1.0
}

fn hundred() -> f64 {
    100.0
}

fn five() -> usize {
    5
}

fn four_to_one() -> [usize; 3] {
    [4, 1, 1]
}

fn car() -> String {
    "Car".into()
}

impl RaceConfig {
    /// Finds a configuration by the path of its TOML file or by a built-in name.
    pub fn find(name_or_path: &str) -> Result<(RaceConfig, ConfigFiles), SimulateError> {
        let (text, path, files) = ConfigFiles::open(name_or_path)?;
        Ok((parse_toml(&text, &path, RaceConfig::check)?, files))
    }

    /// Parses a configuration; `path` is used in error messages.
    pub fn parse(text: &str, path: &Path) -> Result<RaceConfig, SimulateError> {
        Ok(parse_toml(text, path, RaceConfig::check)?)
    }

    /// Checks the configuration; errors name the key.
    pub fn check(&self) -> Result<(), KeyError> {
        check_name("name", &self.name)?;
        within("resolution", self.resolution, 0.01, 8.0)?;
        within("crop_m", self.crop_m, 1.0, 5000.0)?;
        within("label_range_m", self.label_range_m, 1.0, 5000.0)?;
        if self.class.is_empty() || self.class.contains(char::is_whitespace) || self.class == "DontCare" {
            return Err(wrong("class", format!("{:?} is empty, has a space or is DontCare", self.class)));
        }
        self.race.check().map_err(|e| e.below("race"))?;
        let runs = if self.runs.is_empty() { self.race.runs as usize } else { self.runs.len() };
        if self.frames < 6 * runs || self.runs.is_empty() && self.frames > self.race.frames {
            let most = if self.runs.is_empty() { self.race.frames } else { usize::MAX };
            let least = 6 * runs;
            return Err(wrong(
                "frames",
                format!("{} are not between {least} (6 a run) and {most} (those of the race)", self.frames),
            ));
        }
        if self.split_shares.iter().any(|share| !(1..=1000).contains(share)) {
            return Err(wrong("split_shares", format!("{:?} are not between 1 and 1000", self.split_shares)));
        }
        if self.datasets.is_empty() {
            return Err(wrong("dataset", "there is none; say at least [[dataset]] with a name"));
        }
        for (i, set) in self.datasets.iter().enumerate() {
            let before = &self.datasets[..i];
            self.check_set(set, before).map_err(|e| e.below(&format!("dataset[{i}]")))?;
        }
        Ok(())
    }

    fn check_set(&self, set: &SetConfig, before: &[SetConfig]) -> Result<(), KeyError> {
        check_name("name", &set.name)?;
        let named = |name: &String| before.iter().any(|s| s.name == *name);
        if named(&set.name) {
            return Err(wrong("name", format!("{:?} is there twice", set.name)));
        }
        for (key, other) in [("from", &set.from), ("sensor_of", &set.sensor_of), ("matched_to", &set.matched_to)] {
            if let Some(other) = other.as_ref().filter(|other| !named(other)) {
                return Err(wrong(key, format!("{other:?} is no data set that is named before this one")));
            }
        }
        if set.matched_to.is_some() && set.from.is_none() {
            return Err(wrong("matched_to", "needs `from`: the data set whose points are lost"));
        }
        set.auto_label.as_ref().map_or(Ok(()), |auto| auto.check().map_err(|e| e.below("auto_label")))
    }

    /// Number of test frames of each data set.
    pub fn test_frames(&self) -> usize {
        split_sizes(self.frames, self.split_shares)[2]
    }

    /// The effect lists of a data set, with the name of the random stream of each; those of `from` come first.
    pub fn effects_of(&self, set: &SetConfig, files: &ConfigFiles) -> Result<Vec<(String, EffectList)>, SimulateError> {
        let mut lists = match set.from.as_ref().and_then(|from| self.datasets.iter().find(|s| s.name == *from)) {
            Some(from) => self.effects_of(from, files)?,
            None => Vec::new(),
        };
        if let Some(other) = set.sensor_of.as_ref().and_then(|other| self.datasets.iter().find(|s| s.name == *other)) {
            let of_sensor = self.effects_of(other, files)?.into_iter().map(|(name, list)| (name, list.of_sensor()));
            lists.extend(of_sensor);
        }
        if let Some(file) = &set.effects {
            let (text, path) = files.text(file)?;
            lists.push((set.name.clone(), EffectList::parse(&text, &path)?));
        }
        Ok(lists)
    }

    /// The rig at the configured resolution. Every sensor must have a pattern.
    pub fn rig(&self, files: &ConfigFiles) -> Result<Rig, SimulateError> {
        let (text, path) = files.text(&self.rig)?;
        let rig = Rig::parse(&text, &path)?;
        match rig.sensors.iter().find(|s| s.pattern.is_none()) {
            Some(sensor) => Err(data::DataError::file(
                &path,
                format!("sensor {:?} has no pattern, without which nothing can be simulated", sensor.name),
            )
            .into()),
            None => Ok(rig.scaled(self.resolution)),
        }
    }
}

/// Checks that a name can be used as a folder name.
fn check_name(key: &str, name: &str) -> Result<(), KeyError> {
    let plain = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
    data::limits::check_name(name).map_err(|message| wrong(key, message))?;
    if !name.chars().all(plain) {
        return Err(wrong(key, format!("{name:?} is not a name for a file or folder: letters, digits, _ and - only")));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn those_that_come_with_the_program_are_sound() {
        for name in ConfigFiles::NAMES {
            let (config, files) = RaceConfig::find(name).unwrap();
            config.rig(&files).unwrap();
            for set in &config.datasets {
                config.effects_of(set, &files).unwrap();
            }
            assert!(
                config.datasets[0].name == "measured" && config.datasets[0].hidden && config.datasets[1].name == "sim"
            );
        }
    }

    #[test]
    fn bad_configurations_are_refused_by_line() {
        let good = "name = \"r\"\nrig = \"r.toml\"\nframes = 100\n[[dataset]]\nname = \"a\"\n[[dataset]]\nname = \"b\"\nfrom = \"a\"\n";
        RaceConfig::parse(good, Path::new("c.toml")).unwrap();
        for (from, to, want) in [
            ("frames = 100", "frames = 3", "c.toml:3: frames: 3 are not between 18"),
            ("frames = 100", "frames = 99999", "c.toml:3: frames: 99999"),
            ("name = \"r\"", "name = \"../r\"", "c.toml:1: name: \"../r\" is not a name for a file or folder"),
            ("name = \"b\"", "name = \"a\"", "c.toml:7: dataset[1].name: \"a\" is there twice"),
            ("from = \"a\"", "from = \"c\"", "c.toml:8: dataset[1].from: \"c\" is no data set"),
            ("from = \"a\"", "sensor_of = \"c\"", "c.toml:8: dataset[1].sensor_of: \"c\" is no data set"),
            ("from = \"a\"", "matched_to = \"a\"", "c.toml:8: dataset[1].matched_to: needs `from`"),
            (
                "from = \"a\"",
                "[dataset.auto_label]\nrate_hz = 0",
                "c.toml:9: dataset[1].auto_label.rate_hz: 0 is not between",
            ),
            ("frames = 100", "frames = 100\nsplit = \"lot\"", "c.toml:4: split: unknown variant `lot`"),
            (
                "frames = 100",
                "frames = 100\nsplit_shares = [4, 0, 1]",
                "c.toml:4: split_shares: [4, 0, 1] are not between 1 and 1000",
            ),
            ("frames = 100", "frames = 100\nrace = { rivals = 9 }", "c.toml:4: race.rivals: 9 is not between"),
            ("frames = 100", "frames = 100\ncolour = 1", "c.toml:4: unknown field `colour`"),
        ] {
            let text = good.replace(from, to);
            let error = RaceConfig::parse(&text, Path::new("c.toml")).unwrap_err().to_string();
            assert!(error.contains(want), "{error}, not {want}");
        }
    }
}
