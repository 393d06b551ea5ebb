//! Frames in shards: tar files, not compressed, with the members `ID.bin` or `ID.pcd` and `ID.txt` (KITTI text in the
//! label frame of the data set) of many frames each. Other members are ignored, so that shards of WebDataset with such
//! members are read. Frames are read by their position, in any order.
//!
//! The shards are in the folder `shards` below the root, or in the root itself. The folders of members do not matter.

mod index;
mod write;

pub(crate) use write::{ShardFrame, remove_other_shards, shard_name, write_index, write_shard};

use super::DataLayout;
use crate::Presence as _;
use crate::cloud_file::parse_cloud;
use crate::kitti_text::{KittiText, parse_kitti_text};
use crate::limits::{MOST_CLOUD_BYTES, MOST_TEXT_BYTES};
use crate::{Cloud, DataError, DatasetConfig, FilePart, LabelBox, Layout, PointColumns, parse_pcd_header};
use index::ShardIndex;
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, LazyLock, Mutex, MutexGuard, PoisonError};

/// Frames in tar files.
pub(super) struct Shards;

/// Folder of the shards.
pub(crate) const FOLDER: &str = "shards";

/// Indices of the folders that are open.
static OPEN: LazyLock<Mutex<HashMap<PathBuf, Arc<ShardIndex>>>> = LazyLock::new(Mutex::default);

impl DataLayout for Shards {
    fn name(&self) -> &'static str {
        "shards"
    }

    fn markers(&self) -> &'static [&'static str] {
        &["shards/*.tar"]
    }

    fn recognise(&self, folder: &Path) -> Option<DatasetConfig> {
        let has_shards = index::shards_in(&folder_of(folder)).is_ok_and(|shards| !shards.is_empty());
        has_shards.then(|| DatasetConfig { layout: Layout::Shards, root: folder.into(), ..DatasetConfig::default() })
    }

    /// Reads the index anew if shards were changed since.
    fn check_root(&self, root: &Path) -> Result<(), DataError> {
        let folder = folder_of(root);
        let known = open().get(&folder).cloned();
        if known.is_none_or(|index| !index.is_current()) {
            let index = Arc::new(ShardIndex::open(&folder)?);
            open().insert(folder, index);
        }
        Ok(())
    }

    fn frame_ids(&self, root: &Path) -> Result<Vec<String>, DataError> {
        Ok(index(root)?.ids().map(String::from).collect())
    }

    fn cloud_path(&self, root: &Path, id: &str) -> PathBuf {
        let place = index(root).and_then(|index| Ok(index.cloud(id)?.path()));
        place.unwrap_or_else(|_| folder_of(root).join(format!("{id}.bin")))
    }

    fn labels_path(&self, root: &Path, id: &str) -> PathBuf {
        let place = index(root).and_then(|index| Ok(index.labels(id)?.path()));
        place.unwrap_or_else(|_| folder_of(root).join(format!("{id}.txt")))
    }

    fn cloud_part(&self, root: &Path, id: &str) -> Result<FilePart, DataError> {
        let index = index(root)?;
        index.cloud(id)?.part()
    }

    fn labels_part(&self, root: &Path, id: &str) -> Result<FilePart, DataError> {
        let index = index(root)?;
        index.labels(id)?.part()
    }

    fn cloud_place(&self, root: &Path, id: &str) -> Result<FilePart, DataError> {
        Ok(index(root)?.cloud(id)?.place())
    }

    fn labels_place(&self, root: &Path, id: &str) -> Result<FilePart, DataError> {
        Ok(index(root)?.labels(id)?.place())
    }

    fn has_cloud(&self, root: &Path, id: &str) -> bool {
        index(root).is_ok_and(|index| index.cloud(id).is_ok())
    }

    fn has_labels(&self, root: &Path) -> bool {
        index(root).is_ok_and(|index| index.has_labels())
    }

    /// From the header of the first cloud if it is a `.pcd`. A `.bin` has no header: true.
    fn has_intensity(&self, root: &Path) -> Result<bool, DataError> {
        let index = index(root)?;
        let Some(first) = index.ids().next() else { return Ok(true) };
        let member = index.cloud(first)?;
        match member.ending {
            "pcd" => Ok(parse_pcd_header(&member.read(MOST_CLOUD_BYTES)?, &member.path())?.has_intensity()),
            _ => Ok(true),
        }
    }

    fn read_cloud(&self, root: &Path, id: &str, columns: PointColumns) -> Result<Cloud, DataError> {
        let index = index(root)?;
        let member = index.cloud(id)?;
        parse_cloud(&member.read(MOST_CLOUD_BYTES)?, &member.path(), columns)
    }

    /// For a `.bin` the number follows from its size.
    fn count_points(&self, root: &Path, id: &str, columns: PointColumns) -> Result<usize, DataError> {
        let index = index(root)?;
        let member = index.cloud(id)?;
        match member.ending {
            "bin" => Ok(member.length as usize / (columns.channels() * size_of::<f32>())),
            _ => Ok(self.read_cloud(root, id, columns)?.len()),
        }
    }

    fn read_labels(&self, root: &Path, id: &str) -> Result<Vec<LabelBox>, DataError> {
        let index = index(root)?;
        let (member, wrong) = (index.labels(id)?, "is not UTF-8 text");
        let name = member.path();
        let text = String::from_utf8(member.read(MOST_TEXT_BYTES)?);
        parse_kitti_text(&text.map_err(|_| DataError::file(&name, wrong))?, &name, KittiText::Labels)
    }
}

/// Lists the shards of a root.
///
/// # Errors
/// A folder or store that cannot be listed.
pub(crate) fn list_shards(root: &Path) -> Result<(), DataError> {
    index::shards_in(&folder_of(root)).map(drop)
}

/// The folder of the shards of a root.
fn folder_of(root: &Path) -> PathBuf {
    let inside = root.join(FOLDER);
    if inside.may_be_folder() { inside } else { root.into() }
}

/// The index of a root, read once by a process unless [`DataLayout::check_root`] finds that shards were changed.
fn index(root: &Path) -> Result<Arc<ShardIndex>, DataError> {
    let folder = folder_of(root);
    if let Some(index) = open().get(&folder) {
        return Ok(index.clone());
    }
    let index = Arc::new(ShardIndex::open(&folder)?);
    open().insert(folder, index.clone());
    Ok(index)
}

fn open() -> MutexGuard<'static, HashMap<PathBuf, Arc<ShardIndex>>> {
    OPEN.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests;
