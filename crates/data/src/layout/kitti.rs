//! KITTI's object benchmark: `velodyne/*.bin`, `label_2/*.txt` and, where there is a camera, `calib/*.txt`.

use super::file_per_frame::{CloudForm, FilePerFrame, at_root};
use crate::dataset_config::folder_name;
use crate::{DatasetConfig, Layout};
use std::path::{Path, PathBuf};

/// The layout of KITTI's object benchmark.
pub(super) struct Kitti;

impl FilePerFrame for Kitti {
    const LAYOUT: Layout = Layout::Kitti;
    const NAME: &'static str = "kitti";
    const SIGNS: &'static [&'static str] = &["velodyne/ (KITTI)", "training/velodyne/"];
    const FOLDERS: [&'static str; 2] = ["velodyne", "label_2"];
    const CLOUDS: CloudForm = CloudForm::Bin;
    const CALIBRATION: Option<&'static str> = Some("calib");

    /// The folder above `training/`.
    fn recognise_elsewhere(folder: &Path) -> Option<DatasetConfig> {
        let training = folder.join("training");
        let mut config = at_root::<Self>(&training)?;
        config.name = folder_name(folder);
        // Here lie the lists of the whole benchmark, whose `test.txt` speaks of the frames of `testing/`.
        for name in ["train", "val"] {
            let list = PathBuf::from(format!("../ImageSets/{name}.txt"));
            if training.join(&list).is_file() {
                config.splits.insert(name.into(), list);
            }
        }
        Some(config)
    }
}
