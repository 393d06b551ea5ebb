//! KITTI's object benchmark: `velodyne/*.bin`, `label_2/*.txt` and, if there is a camera, `calib/*.txt`.

use super::file_per_frame::{CloudFormat, FilePerFrame, at_root};
use crate::Presence as _;
use crate::dataset_config::folder_name;
use crate::{DatasetConfig, Layout};
use std::path::{Path, PathBuf};

/// The layout of KITTI's object benchmark.
pub(super) struct Kitti;

impl FilePerFrame for Kitti {
    const LAYOUT: Layout = Layout::Kitti;
    const NAME: &'static str = "kitti";
    const MARKERS: &'static [&'static str] = &["velodyne/ (KITTI)", "training/velodyne/"];
    const FOLDERS: [&'static str; 2] = ["velodyne", "label_2"];
    const CLOUDS: CloudFormat = CloudFormat::Bin;
    const CALIBRATION: Option<&'static str> = Some("calib");

    /// Recognises the parent of `training/`.
    fn recognise_other_root(folder: &Path) -> Option<DatasetConfig> {
        let training = folder.join("training");
        let mut config = at_root::<Self>(&training)?;
        config.name = folder_name(folder);
        // ImageSets is beside `training/`. Its `test.txt` lists frames of `testing/` and is not used.
        for name in ["train", "val"] {
            let list = PathBuf::from(format!("../ImageSets/{name}.txt"));
            if training.join(&list).may_be_file() {
                config.splits.insert(name.into(), list);
            }
        }
        Some(config)
    }
}
