//! Detectors by name: the files of `configs/detectors`, built into the program.

use crate::ModelError;
use crate::config::DetectorConfig;
use data::Presence as _;
use std::path::Path;

/// The text of a detector's TOML, by its name or its path.
///
/// # Errors
/// Neither a name nor a file.
pub fn detector_text(name_or_path: &str) -> Result<String, ModelError> {
    if let Some(text) = configs::text(&format!("detectors/{name_or_path}.toml")) {
        return Ok(text.to_string());
    }
    let path = Path::new(name_or_path);
    if !path.may_exist() {
        let names: Vec<&str> = configs::names("detectors").collect();
        let message = format!("there is no such detector: neither a file nor one of {}", names.join(", "));
        return Err(ModelError::File { path: path.into(), message });
    }
    Ok(data::limits::read_text(path)?)
}

/// A detector by its name or its path.
///
/// # Errors
/// Neither a name nor a file, or a file that is wrong.
pub fn find_detector(name_or_path: &str) -> Result<DetectorConfig, ModelError> {
    let text = detector_text(name_or_path)?;
    DetectorConfig::parse(&text).map_err(|message| ModelError::File { path: name_or_path.into(), message })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn built_in_files_are_right() {
        for name in configs::names("detectors") {
            assert_eq!(find_detector(name).unwrap().name, name);
        }
        assert!(configs::names("detectors").count() >= 8);
        assert!(find_detector("pointpilars").unwrap_err().to_string().contains("pointpillars_small"));
    }
}
