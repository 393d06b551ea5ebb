//! Tests of the configuration files in the repository.

use data::DatasetConfig;
use lidarshift_tests::workspace;
use models::find_detector;

#[test]
fn data_sets_and_detectors_are_right() {
    let tomls = |folder: &str| {
        let entries = std::fs::read_dir(workspace(folder)).unwrap().map(|entry| entry.unwrap().path());
        let found: Vec<_> = entries.filter(|path| path.extension().is_some_and(|e| e == "toml")).collect();
        assert!(found.len() >= 2, "{folder}");
        found
    };
    for path in tomls("datasets") {
        let config = DatasetConfig::read(&path).unwrap();
        assert_eq!(config.name, path.file_stem().unwrap().to_str().unwrap());
        assert!(!config.splits.is_empty() && !config.classes.is_empty());
    }
    for path in tomls("configs/detectors") {
        let name = path.file_stem().unwrap().to_str().unwrap();
        // A built-in configuration is equal to the file of the same name.
        assert_eq!(find_detector(path.to_str().unwrap()).unwrap(), find_detector(name).unwrap());
    }
}
