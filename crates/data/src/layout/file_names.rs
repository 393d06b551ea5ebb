//! Folders of a layout and the ids that the names of their files are.

use crate::DataError;
use crate::limits::{MOST_IDS, at_most};
use rayon::prelude::*;
use std::path::Path;

/// An error that names the folder if it does not exist.
pub(super) fn check_folder(folder: &Path) -> Result<(), DataError> {
    if folder.is_dir() {
        return Ok(());
    }
    Err(DataError::missing(folder, "does not exist: check `root` and `layout` of the data set"))
}

/// The names of the files in `folder` that end with `ending`, without it, sorted.
///
/// # Errors
/// There is no such file.
pub(super) fn ids_of_files(folder: &Path, ending: &str) -> Result<Vec<String>, DataError> {
    let mut ids = Vec::new();
    for entry in fs_err::read_dir(folder)? {
        let path = entry?.path();
        let Some(name) = path.file_name() else { continue };
        let name = name.to_str().ok_or_else(|| DataError::file(&path, "its name is not UTF-8"))?;
        if let Some(id) = name.strip_suffix(ending).filter(|id| !id.is_empty()) {
            at_most(folder, "frames", ids.len() as u64 + 1, MOST_IDS)?;
            ids.push(id.to_string());
        }
    }
    if ids.is_empty() {
        return Err(DataError::file(folder, format!("has no file whose name ends in {ending}")));
    }
    ids.par_sort_unstable();
    Ok(ids)
}
