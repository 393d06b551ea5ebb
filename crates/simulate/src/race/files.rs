//! Source of configuration files: a folder, or built into the program.

use crate::SimulateError;
use data::DataError;
use data::Presence as _;
use std::path::{Path, PathBuf};

/// The files next to a configuration.
#[derive(Clone, Debug, PartialEq)]
pub struct ConfigFiles {
    /// Folder of the configuration; `None` if built in.
    folder: Option<PathBuf>,
}

impl ConfigFiles {
    /// Names of the built-in configurations.
    pub const NAMES: [&str; 4] = ["race", "race_small", "race_full", "race_study"];

    /// Files in a folder.
    pub fn in_folder(folder: &Path) -> ConfigFiles {
        ConfigFiles { folder: Some(folder.into()) }
    }

    /// Text and path of a configuration given by path or built-in name, and the files next to it.
    pub fn open(name_or_path: &str) -> Result<(String, PathBuf, ConfigFiles), SimulateError> {
        let path = PathBuf::from(name_or_path);
        if !path.may_be_file() && ConfigFiles::NAMES.contains(&name_or_path) {
            let files = ConfigFiles { folder: None };
            let (text, path) = files.text(Path::new(&format!("{name_or_path}.toml")))?;
            return Ok((text, path, files));
        }
        if !path.may_be_file() {
            let message =
                format!("does not exist, and is none that comes with the program ({})", ConfigFiles::NAMES.join(", "));
            return Err(DataError::missing(&path, message).into());
        }
        let files = ConfigFiles::in_folder(path.parent().unwrap_or(Path::new("")));
        Ok((read(&path)?, path, files))
    }

    /// Text and path of a file referenced by the configuration.
    pub fn text(&self, file: &Path) -> Result<(String, PathBuf), SimulateError> {
        match &self.folder {
            Some(folder) => {
                let path = folder.join(file);
                Ok((read(&path)?, path))
            }
            None => {
                let below = Path::new("simulate").join(file);
                let name = below.to_string_lossy().replace("simulate/../", "");
                match configs::text(&name) {
                    Some(text) => Ok((text.into(), Path::new("configs").join(name))),
                    None => Err(DataError::file(file, "does not come with the program").into()),
                }
            }
        }
    }

    /// Folder to which further paths are relative.
    pub fn folder(&self) -> PathBuf {
        self.folder.clone().unwrap_or_default()
    }
}

fn read(path: &Path) -> Result<String, SimulateError> {
    Ok(data::limits::read_text(path)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn by_name_and_by_path() {
        let (by_name, path, files) = ConfigFiles::open("race").unwrap();
        assert_eq!(path, Path::new("configs/simulate/race.toml"));
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/simulate");
        let (by_path, _, near) = ConfigFiles::open(&root.join("race.toml").display().to_string()).unwrap();
        assert_eq!(by_name, by_path);
        let rig = Path::new("../sensors/av21.toml");
        assert_eq!(files.text(rig).unwrap().0, near.text(rig).unwrap().0);
        let error = ConfigFiles::open("races").unwrap_err().to_string();
        assert!(error.contains("races: does not exist") && error.contains("race_small"), "{error}");
    }
}
