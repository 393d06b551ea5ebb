//! A configuration of `simulate`, found by name or by file.

use crate::race::{ConfigFiles, RaceConfig};
use crate::{FrameCounts, RoadConfig, SimulateError};
use data::Presence as _;
use data::toml_text::wrong;
use std::path::Path;

/// Configuration of a data set to simulate.
pub enum Scenery {
    /// A street.
    Street(RoadConfig),
    /// A race and the files that its configuration names.
    Race(Box<(RaceConfig, ConfigFiles)>),
}

impl Scenery {
    /// The configuration with a built-in name (`race`, `race_small`, `street`, ...) or in a TOML file. `frames` and
    /// `seed` replace its values.
    ///
    /// # Errors
    /// There is no configuration of this name, the file is invalid, or the number of frames is not possible.
    pub fn find(name_or_path: &str, frames: Option<usize>, seed: Option<u64>) -> Result<Self, SimulateError> {
        let path = Path::new(name_or_path);
        let is_street = if path.may_be_file() {
            let text = data::limits::read_text(path)?;
            // A race names its sensors. Invalid TOML is treated as a race; its reader reports the line of the error.
            text.parse::<toml::Table>().is_ok_and(|table| !table.contains_key("rig"))
        } else {
            name_or_path == "street"
        };
        if is_street {
            return Ok(Scenery::Street(street(path.may_be_file().then_some(path), frames, seed)?));
        }
        let (mut config, files) = RaceConfig::find(name_or_path)?;
        config.seed = seed.unwrap_or(config.seed);
        config.frames = frames.unwrap_or(config.frames);
        config.check().map_err(|e| wrong("--frames or --seed do not fit the configuration", e.to_string()))?;
        Ok(Scenery::Race(Box::new((config, files))))
    }
}

fn street(path: Option<&Path>, frames: Option<usize>, seed: Option<u64>) -> Result<RoadConfig, SimulateError> {
    let mut config = path.map_or(Ok(RoadConfig::default()), RoadConfig::read)?;
    config.seed = seed.unwrap_or(config.seed);
    if let Some(total) = frames {
        config.frames = FrameCounts::scaled_to(&config.frames, total)
            .ok_or_else(|| wrong(format!("--frames {total}"), "there must be at least 3, one for each split"))?;
    }
    Ok(config)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arguments_replace_values_of_the_configuration() {
        let Scenery::Street(config) = Scenery::find("street", Some(36), Some(9)).unwrap() else { panic!("a street") };
        assert_eq!((config.frames.total(), config.seed), (36, 9));
        assert!(Scenery::find("street", Some(2), None).is_err());
        let Scenery::Race(race) = Scenery::find("race", Some(36), Some(9)).unwrap() else { panic!("a race") };
        assert_eq!((race.0.frames, race.0.seed), (36, 9));
        assert!(Scenery::find("race", Some(2), None).is_err());
        let error = Scenery::find("rce", None, None).err().unwrap().to_string();
        assert!(error.contains("race_small"), "{error}");
    }

    #[test]
    fn files_with_a_rig_are_races_and_others_streets() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.toml");
        std::fs::write(&path, "[frames]\ntrain = 5\n").unwrap();
        assert!(matches!(Scenery::find(path.to_str().unwrap(), None, None), Ok(Scenery::Street(_))));
        std::fs::write(&path, "name = \"a\"\nrig = \"r.toml\"\nframes = 2\n").unwrap();
        let error = Scenery::find(path.to_str().unwrap(), None, None).err().unwrap().to_string();
        assert!(error.contains("a.toml:3: frames"), "{error}");
    }
}
