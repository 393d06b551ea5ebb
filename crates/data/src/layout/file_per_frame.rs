//! Layouts with one cloud file (`.bin` or `.pcd`) and one label file (KITTI text) per frame, in two folders.

use super::DataLayout;
use crate::Presence as _;
use crate::kitti_text::{KittiText, read_kitti_text};
use crate::limits::{MOST_CLOUD_BYTES, read_file};
use crate::write::{write_bin, write_kitti_text, write_pcd};
use crate::{Calibration, Cloud, DataError, DatasetConfig, LabelBox, LabelFrame, PcdEncoding, PointColumns};
use crate::{Layout, parse_pcd_header, read_cloud};
use fs_err::DirEntry;
use rayon::prelude::*;
use std::path::{Path, PathBuf};

/// File format of a cloud.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum CloudFormat {
    /// Little-endian f32. The number of values per point is given by the data set.
    Bin,
    /// PCD, written with `DATA binary`.
    Pcd,
}

impl CloudFormat {
    fn extension(self) -> &'static str {
        match self {
            CloudFormat::Bin => "bin",
            CloudFormat::Pcd => "pcd",
        }
    }

    fn other(self) -> Self {
        match self {
            CloudFormat::Bin => CloudFormat::Pcd,
            CloudFormat::Pcd => CloudFormat::Bin,
        }
    }
}

/// Folders and formats of such a layout. Every implementation is a [`DataLayout`].
pub(super) trait FilePerFrame: Send + Sync {
    /// Its variant of [`Layout`].
    const LAYOUT: Layout;
    /// The name of the layout in a data set's TOML.
    const NAME: &'static str;
    /// Folders by which the layout is recognised without a TOML, for error messages.
    const MARKERS: &'static [&'static str];
    /// Folder of the clouds and folder of the labels, relative to the root.
    const FOLDERS: [&'static str; 2];
    /// Format in which clouds are written. A cloud in the other format is read if there is none in this one.
    const CLOUDS: CloudFormat;
    /// Folder of the camera calibrations, relative to the root; `None` if the layout has no calibration.
    const CALIBRATION: Option<&'static str> = None;

    /// The configuration of a folder that is not itself the root, such as the parent of the root.
    fn recognise_other_root(_folder: &Path) -> Option<DatasetConfig> {
        None
    }
}

/// The configuration of a data set with this root; `None` if the folder of clouds does not exist.
pub(super) fn at_root<L: FilePerFrame>(root: &Path) -> Option<DatasetConfig> {
    let config = DatasetConfig { layout: L::LAYOUT, root: root.into(), ..DatasetConfig::default() };
    root.join(L::FOLDERS[0]).may_be_folder().then_some(config)
}

impl<L: FilePerFrame> DataLayout for L {
    fn name(&self) -> &'static str {
        L::NAME
    }

    fn markers(&self) -> &'static [&'static str] {
        L::MARKERS
    }

    fn recognise(&self, folder: &Path) -> Option<DatasetConfig> {
        at_root::<L>(folder).or_else(|| L::recognise_other_root(folder))
    }

    fn check_root(&self, root: &Path) -> Result<(), DataError> {
        let clouds = root.join(L::FOLDERS[0]);
        if !clouds.may_be_folder() {
            return Err(DataError::missing(&clouds, "does not exist: check `root` and `layout` of the data set"));
        }
        Ok(())
    }

    fn frame_ids(&self, root: &Path) -> Result<Vec<String>, DataError> {
        let folder = root.join(L::FOLDERS[0]);
        let ids = ids_of_clouds(&folder, |_| true)?;
        if ids.is_empty() {
            return Err(DataError::file(&folder, "has no .bin or .pcd file"));
        }
        Ok(ids)
    }

    /// Of many frames the folder is read once. What it does not list as a regular file, such as a symbolic link, is
    /// asked for.
    fn first_without_cloud(&self, root: &Path, ids: &[&str]) -> Option<usize> {
        let is_file = |entry: &DirEntry| entry.file_type().is_ok_and(|kind| kind.is_file());
        let listed = (ids.len() > FEW_FRAMES).then(|| ids_of_clouds(&root.join(L::FOLDERS[0]), is_file));
        let listed = listed.and_then(Result::ok).unwrap_or_default();
        let is_listed = |id: &str| listed.binary_search_by(|known| known.as_str().cmp(id)).is_ok();
        ids.par_iter().position_first(|id| !is_listed(id) && !self.has_cloud(root, id))
    }

    fn cloud_path(&self, root: &Path, id: &str) -> PathBuf {
        let path = |format: CloudFormat| root.join(L::FOLDERS[0]).join(format!("{id}.{}", format.extension()));
        let (usual, other) = (path(L::CLOUDS), path(L::CLOUDS.other()));
        if !usual.may_be_file() && other.may_be_file() { other } else { usual }
    }

    fn labels_path(&self, root: &Path, id: &str) -> PathBuf {
        root.join(L::FOLDERS[1]).join(format!("{id}.txt"))
    }

    fn has_labels(&self, root: &Path) -> bool {
        root.join(L::FOLDERS[1]).may_be_folder()
    }

    /// From the header of the first cloud if it is a `.pcd`. A `.bin` has no header: true.
    fn has_intensity(&self, root: &Path) -> Result<bool, DataError> {
        let path = self.cloud_path(root, &self.frame_ids(root)?[0]);
        if is_bin(&path) {
            return Ok(true);
        }
        Ok(parse_pcd_header(&read_file(&path, MOST_CLOUD_BYTES)?, &path)?.has_intensity())
    }

    fn read_cloud(&self, root: &Path, id: &str, columns: PointColumns) -> Result<Cloud, DataError> {
        read_cloud(&self.cloud_path(root, id), columns)
    }

    /// For a `.bin` the number follows from the file size.
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

    fn supports_calibration(&self) -> bool {
        L::CALIBRATION.is_some()
    }

    fn default_label_frame(&self, root: &Path) -> LabelFrame {
        match L::CALIBRATION {
            Some(folder) if root.join(folder).may_be_folder() => LabelFrame::Camera,
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
        let path = root.join(L::FOLDERS[0]).join(format!("{id}.{}", L::CLOUDS.extension()));
        match L::CLOUDS {
            CloudFormat::Bin => write_bin(&path, cloud),
            CloudFormat::Pcd => write_pcd(&path, cloud, PcdEncoding::Binary),
        }
    }

    fn write_labels(&self, root: &Path, id: &str, labels: &[LabelBox]) -> Result<(), DataError> {
        write_kitti_text(&self.labels_path(root, id), labels)
    }
}

/// Number of frames up to which each is asked for.
const FEW_FRAMES: usize = 16;

/// The names in a folder that end in `.bin` or `.pcd`, without the ending, sorted; of the entries that are `wanted`.
fn ids_of_clouds(folder: &Path, wanted: impl Fn(&DirEntry) -> bool) -> Result<Vec<String>, DataError> {
    let mut ids = Vec::new();
    for entry in fs_err::read_dir(folder)? {
        let entry = entry?;
        let name = entry.file_name();
        let name = Path::new(&name);
        let (Some("bin" | "pcd"), Some(id)) = (name.extension().and_then(|e| e.to_str()), name.file_stem()) else {
            continue;
        };
        if wanted(&entry) {
            let id = id.to_str().ok_or_else(|| DataError::file(&entry.path(), "its name is not UTF-8"))?;
            ids.push(id.to_string());
        }
    }
    ids.par_sort_unstable();
    ids.dedup();
    Ok(ids)
}

fn is_bin(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension == "bin")
}
