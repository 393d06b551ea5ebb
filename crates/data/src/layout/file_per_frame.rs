//! Layouts with a folder of clouds (`.bin` or `.pcd`) and a folder of labels (KITTI text), a file a frame in each.

use super::DataLayout;
use crate::kitti_text::{KittiText, read_kitti_text};
use crate::write::{write_bin, write_kitti_text, write_pcd};
use crate::{Calibration, Cloud, DataError, DatasetConfig, LabelBox, LabelFrame, PcdEncoding, PointColumns};
use crate::{Layout, parse_pcd_header, read_cloud};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// The form of a cloud's file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum CloudForm {
    /// Little-endian f32, as many a point as the data set says.
    Bin,
    /// PCD, written in its binary form.
    Pcd,
}

impl CloudForm {
    fn ending(self) -> &'static str {
        match self {
            CloudForm::Bin => "bin",
            CloudForm::Pcd => "pcd",
        }
    }

    fn other(self) -> Self {
        match self {
            CloudForm::Bin => CloudForm::Pcd,
            CloudForm::Pcd => CloudForm::Bin,
        }
    }
}

/// Where such a layout has its files. All else follows: it is a [`DataLayout`].
pub(super) trait FilePerFrame: Send + Sync {
    /// Its entry in the list of layouts.
    const LAYOUT: Layout;
    /// The name as a data set's TOML spells it.
    const NAME: &'static str;
    /// What a folder without a TOML is known by, for messages.
    const SIGNS: &'static [&'static str];
    /// Folder of the clouds and folder of the labels, relative to the root.
    const FOLDERS: [&'static str; 2];
    /// How clouds are written. A cloud in the other form is read where there is none in this one.
    const CLOUDS: CloudForm;
    /// Folder of the cameras' calibrations, relative to the root, if the layout can have one.
    const CALIBRATION: Option<&'static str> = None;

    /// The data set in a folder whose root lies elsewhere than in the folder itself.
    fn recognise_elsewhere(_folder: &Path) -> Option<DatasetConfig> {
        None
    }
}

/// The data set at a root.
pub(super) fn at_root<L: FilePerFrame>(root: &Path) -> Option<DatasetConfig> {
    let config = DatasetConfig { layout: L::LAYOUT, root: root.into(), ..DatasetConfig::default() };
    root.join(L::FOLDERS[0]).is_dir().then_some(config)
}

impl<L: FilePerFrame> DataLayout for L {
    fn name(&self) -> &'static str {
        L::NAME
    }

    fn signs(&self) -> &'static [&'static str] {
        L::SIGNS
    }

    fn recognise(&self, folder: &Path) -> Option<DatasetConfig> {
        at_root::<L>(folder).or_else(|| L::recognise_elsewhere(folder))
    }

    fn check_root(&self, root: &Path) -> Result<(), DataError> {
        let clouds = root.join(L::FOLDERS[0]);
        if !clouds.is_dir() {
            return Err(DataError::file(&clouds, "does not exist: check root and layout of the data set"));
        }
        Ok(())
    }

    fn frame_ids(&self, root: &Path) -> Result<Vec<String>, DataError> {
        let folder = root.join(L::FOLDERS[0]);
        let mut ids = BTreeSet::new();
        for entry in fs_err::read_dir(&folder)? {
            let path = entry?.path();
            let ending = path.extension().and_then(|e| e.to_str());
            let (Some("bin" | "pcd"), Some(id)) = (ending, path.file_stem()) else { continue };
            let id = id.to_str().ok_or_else(|| DataError::file(&path, "its name is not UTF-8"))?;
            ids.insert(id.to_string());
        }
        if ids.is_empty() {
            return Err(DataError::file(&folder, "has no .bin and no .pcd"));
        }
        Ok(ids.into_iter().collect())
    }

    fn cloud_path(&self, root: &Path, id: &str) -> PathBuf {
        let path = |form: CloudForm| root.join(L::FOLDERS[0]).join(format!("{id}.{}", form.ending()));
        let (usual, other) = (path(L::CLOUDS), path(L::CLOUDS.other()));
        if !usual.is_file() && other.is_file() { other } else { usual }
    }

    fn labels_path(&self, root: &Path, id: &str) -> PathBuf {
        root.join(L::FOLDERS[1]).join(format!("{id}.txt"))
    }

    fn has_labels(&self, root: &Path) -> bool {
        root.join(L::FOLDERS[1]).is_dir()
    }

    /// What the first cloud says, for a `.pcd`; a `.bin` says nothing and is believed.
    fn has_intensity(&self, root: &Path) -> Result<bool, DataError> {
        let path = self.cloud_path(root, &self.frame_ids(root)?[0]);
        if is_bin(&path) {
            return Ok(true);
        }
        Ok(parse_pcd_header(&fs_err::read(&path)?, &path)?.has_intensity())
    }

    fn read_cloud(&self, root: &Path, id: &str, columns: PointColumns) -> Result<Cloud, DataError> {
        read_cloud(&self.cloud_path(root, id), columns)
    }

    /// The size of a `.bin` says it.
    fn count_points(&self, root: &Path, id: &str, columns: PointColumns) -> Result<usize, DataError> {
        let path = self.cloud_path(root, id);
        if is_bin(&path) {
            return Ok(fs_err::metadata(&path)?.len() as usize / (columns.channels() * size_of::<f32>()));
        }
        Ok(read_cloud(&path, columns)?.len())
    }

    fn read_labels(&self, root: &Path, id: &str) -> Result<Vec<LabelBox>, DataError> {
        read_kitti_text(&self.labels_path(root, id), KittiText::Labels)
    }

    fn knows_camera(&self) -> bool {
        L::CALIBRATION.is_some()
    }

    fn usual_label_frame(&self, root: &Path) -> LabelFrame {
        match L::CALIBRATION {
            Some(folder) if root.join(folder).is_dir() => LabelFrame::Camera,
            _ => LabelFrame::Lidar,
        }
    }

    fn calibration_path(&self, root: &Path, id: &str) -> Option<PathBuf> {
        L::CALIBRATION.map(|folder| root.join(folder).join(format!("{id}.txt")))
    }

    fn read_calibration(&self, root: &Path, id: &str) -> Result<Calibration, DataError> {
        match self.calibration_path(root, id) {
            Some(path) => Calibration::read(&path),
            None => Err(DataError::file(root, format!("the layout {} has no calibration", L::NAME))),
        }
    }

    fn folders(&self) -> &'static [&'static str] {
        &L::FOLDERS
    }

    fn write_cloud(&self, root: &Path, id: &str, cloud: &Cloud) -> Result<(), DataError> {
        let path = root.join(L::FOLDERS[0]).join(format!("{id}.{}", L::CLOUDS.ending()));
        match L::CLOUDS {
            CloudForm::Bin => write_bin(&path, cloud),
            CloudForm::Pcd => write_pcd(&path, cloud, PcdEncoding::Binary),
        }
    }

    fn write_labels(&self, root: &Path, id: &str, labels: &[LabelBox]) -> Result<(), DataError> {
        write_kitti_text(&self.labels_path(root, id), labels)
    }
}

fn is_bin(path: &Path) -> bool {
    path.extension().is_some_and(|ending| ending == "bin")
}
