//! Detectors by name: the files of `configs/detectors`, built into the program.

use anyhow::{Context, Result, bail};
use models::config::DetectorConfig;
use std::path::Path;

const BUILT_IN: [(&str, &str); 8] = [
    ("pointpillars", include_str!("../../../configs/detectors/pointpillars.toml")),
    ("pointpillars_small", include_str!("../../../configs/detectors/pointpillars_small.toml")),
    ("pointpillars_race", include_str!("../../../configs/detectors/pointpillars_race.toml")),
    ("pointpillars_race_small", include_str!("../../../configs/detectors/pointpillars_race_small.toml")),
    ("pointrcnn", include_str!("../../../configs/detectors/pointrcnn.toml")),
    ("pointrcnn_small", include_str!("../../../configs/detectors/pointrcnn_small.toml")),
    ("pointrcnn_race", include_str!("../../../configs/detectors/pointrcnn_race.toml")),
    ("pointrcnn_race_small", include_str!("../../../configs/detectors/pointrcnn_race_small.toml")),
];

/// The text of a detector's TOML, by its name or its path.
///
/// # Errors
/// Neither a name nor a file.
pub fn detector_text(name_or_path: &str) -> Result<String> {
    if let Some((_, text)) = BUILT_IN.iter().find(|(name, _)| *name == name_or_path) {
        return Ok((*text).to_string());
    }
    let path = Path::new(name_or_path);
    if !path.is_file() {
        let names: Vec<&str> = BUILT_IN.iter().map(|(name, _)| *name).collect();
        bail!("no detector {name_or_path:?}: neither a file nor one of {}", names.join(", "));
    }
    Ok(fs_err::read_to_string(path)?)
}

/// A detector by its name or its path.
///
/// # Errors
/// Neither a name nor a file, or a file that is wrong.
pub fn find_detector(name_or_path: &str) -> Result<DetectorConfig> {
    DetectorConfig::parse(&detector_text(name_or_path)?).map_err(anyhow::Error::msg).context(name_or_path.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn built_in_files_are_right() {
        for (name, _) in BUILT_IN {
            assert_eq!(find_detector(name).unwrap().name, name);
        }
        assert!(find_detector("pointpilars").unwrap_err().to_string().contains("pointpillars_small"));
    }
}
