//! What a race's data sets are made of, as people write it in TOML.

use crate::SimulateError;
use crate::auto_label::AutoLabel;
use crate::mesh::MeshFile;
use crate::race::files::ConfigFiles;
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

/// A race and the data sets that are made of it. Paths are relative to the file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RaceConfig {
    /// Name of the folder of the data sets, and the first part of their names.
    pub name: String,
    /// Another seed gives another race and other noise.
    #[serde(default)]
    pub seed: u64,
    /// The sensors.
    pub rig: PathBuf,
    /// Rows and columns of the sensors, as a part of those of the rig.
    #[serde(default = "one")]
    pub resolution: f64,
    /// Frames that are kept, evenly over all runs.
    pub frames: usize,
    /// How frames go into train, val and test.
    #[serde(default)]
    pub split: SplitKind,
    /// Points farther than this from the origin along x or y are left out, m.
    #[serde(default = "hundred")]
    pub crop_m: f64,
    /// Cars whose middle is farther away, seen from above, have no label, m.
    #[serde(default = "hundred")]
    pub label_range_m: f64,
    /// Cars of which the rig without any effect has fewer returns, because others hide them or no shot meets them, have no label.
    #[serde(default = "five")]
    pub label_points: usize,
    /// Class of the cars in the labels.
    #[serde(default = "car")]
    pub class: String,
    /// Where the files lie below the folder of a data set.
    #[serde(default)]
    pub layout: Layout,
    /// Write what is known of each point beside the clouds.
    #[serde(default)]
    pub attributes: bool,
    /// The track.
    #[serde(default)]
    pub track: TrackConfig,
    /// The race that the program makes, unless there are runs in files.
    #[serde(default)]
    pub race: RaceModel,
    /// Runs from files.
    #[serde(default, rename = "run")]
    pub runs: Vec<RunFiles>,
    /// The mesh of the cars in the car's frame; without one the program's own racing car.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub car: Option<MeshFile>,
    /// Materials that are changed or added.
    #[serde(default)]
    pub materials: BTreeMap<String, Material>,
    /// The data sets, in the order in which they are made.
    #[serde(default, rename = "dataset")]
    pub datasets: Vec<SetConfig>,
}

/// The track and what stands around it.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct TrackConfig {
    /// CSV of the centre line; without one an oval after the Las Vegas Motor Speedway.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub file: Option<PathBuf>,
    /// Another seed, another roadside.
    pub seed: u64,
}

/// How frames go into train, val and test, in the shares 4 : 1 : 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum SplitKind {
    /// In each run one block after the other, frames left out between them where there are more than are kept.
    #[default]
    Blocks,
    /// Each frame by lot: neighbours of a frame to train on are tested.
    Random,
}

/// One of the data sets; all have the same frames.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SetConfig {
    /// Name of its folder.
    pub name: String,
    /// File of its effects; none without.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub effects: Option<PathBuf>,
    /// It is this other data set (named before it) with the effects on top.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub from: Option<String>,
    /// On top of its effects, points are lost by range until their ranges are distributed as in this other data set (named before it).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub matched_to: Option<String>,
    /// Labels as they are made on the road; without it they are exact.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub auto_label: Option<AutoLabel>,
    /// Do not write its effects into its folder: for a data set that stands for the road.
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

fn car() -> String {
    "Car".into()
}

impl RaceConfig {
    /// A configuration by the path of its TOML, or by the name of one that comes with the program.
    pub fn find(name_or_path: &str) -> Result<(RaceConfig, ConfigFiles), SimulateError> {
        let (text, path, files) = ConfigFiles::open(name_or_path)?;
        Ok((parse_toml(&text, &path, RaceConfig::check)?, files))
    }

    /// A configuration in memory; `path` is where it lies, for messages.
    pub fn parse(text: &str, path: &Path) -> Result<RaceConfig, SimulateError> {
        Ok(parse_toml(text, path, RaceConfig::check)?)
    }

    /// Refuses what cannot be made, naming the key.
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
        for (key, other) in [("from", &set.from), ("matched_to", &set.matched_to)] {
            if let Some(other) = other.as_ref().filter(|other| !named(other)) {
                return Err(wrong(key, format!("{other:?} is no data set that is named before this one")));
            }
        }
        if set.matched_to.is_some() && set.from.is_none() {
            return Err(wrong("matched_to", "needs `from`: the data set whose points are lost"));
        }
        set.auto_label.as_ref().map_or(Ok(()), |auto| auto.check().map_err(|e| e.below("auto_label")))
    }

    /// The effects of a data set: lists with the name under which each draws its random numbers, those of `from` first.
    pub fn effects_of(&self, set: &SetConfig, files: &ConfigFiles) -> Result<Vec<(String, EffectList)>, SimulateError> {
        let mut lists = match set.from.as_ref().and_then(|from| self.datasets.iter().find(|s| s.name == *from)) {
            Some(from) => self.effects_of(from, files)?,
            None => Vec::new(),
        };
        if let Some(file) = &set.effects {
            let (text, path) = files.text(file)?;
            lists.push((set.name.clone(), EffectList::parse(&text, &path)?));
        }
        Ok(lists)
    }

    /// The sensors at the wanted resolution. Each has a pattern.
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

/// Names become folders.
fn check_name(key: &str, name: &str) -> Result<(), KeyError> {
    let plain = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
    if name.is_empty() || !name.chars().all(plain) {
        return Err(wrong(key, format!("{name:?} is no name of a folder: letters, digits, _ and - only")));
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
            ("name = \"r\"", "name = \"../r\"", "c.toml:1: name: \"../r\" is no name of a folder"),
            ("name = \"b\"", "name = \"a\"", "c.toml:7: dataset[1].name: \"a\" is there twice"),
            ("from = \"a\"", "from = \"c\"", "c.toml:8: dataset[1].from: \"c\" is no data set"),
            ("from = \"a\"", "matched_to = \"a\"", "c.toml:8: dataset[1].matched_to: needs `from`"),
            (
                "from = \"a\"",
                "[dataset.auto_label]\nrate_hz = 0",
                "c.toml:9: dataset[1].auto_label.rate_hz: 0 is not between",
            ),
            ("frames = 100", "frames = 100\nsplit = \"lot\"", "c.toml:4: unknown variant `lot`"),
            ("frames = 100", "frames = 100\nrace = { rivals = 9 }", "c.toml:4: race.rivals: 9 is not between"),
            ("frames = 100", "frames = 100\ncolour = 1", "c.toml:4: unknown field `colour`"),
        ] {
            let text = good.replace(from, to);
            let error = RaceConfig::parse(&text, Path::new("c.toml")).unwrap_err().to_string();
            assert!(error.contains(want), "{error}, not {want}");
        }
    }
}
