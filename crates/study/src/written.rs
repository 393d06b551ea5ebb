//! The files of a cell of the matrix as they were written, recorded in its `cell.json`.

use crate::error::Result;
use data::checksum::file_sha256;
use data::{DETECTIONS_FILE, DataError, Presence as _};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Size and content of a file.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub(crate) struct WrittenFile {
    bytes: u64,
    /// In hexadecimal.
    sha256: String,
}

/// The files of a cell.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub(crate) struct CellFiles {
    /// `detections.parquet` in the folder of the cell.
    pub detections: WrittenFile,
    /// `detections.parquet` in the folder of the regions; none if the network has one stage.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub regions: Option<WrittenFile>,
}

impl WrittenFile {
    /// A file as it is.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub(crate) fn of(path: &Path) -> Result<WrittenFile> {
        Ok(WrittenFile { bytes: fs_err::metadata(path)?.len(), sha256: file_sha256(path)? })
    }

    /// Whether the file has its size. Reading a file of a million frames for the state of a study would take too long.
    fn is_there(&self, path: &Path) -> bool {
        match fs_err::metadata(path) {
            Ok(metadata) => metadata.is_file() && metadata.len() == self.bytes,
            Err(_) => path.may_be_file(),
        }
    }
}

/// The part of `cell.json` that is read here.
#[derive(Deserialize)]
struct Cell {
    files: Option<CellFiles>,
}

impl CellFiles {
    /// Whether the files of a cell exist: its text files if it has no others. `folders` are those of the detections and
    /// of the regions.
    pub(crate) fn are_there(files: Option<&CellFiles>, folders: &[PathBuf; 2], ids: &[String]) -> bool {
        let Some(files) = files else {
            return ids.iter().all(|id| folders[0].join(format!("{id}.txt")).may_be_file());
        };
        files.in_folders(folders).all(|(path, file)| file.is_there(&path))
    }

    fn in_folders<'a>(
        &'a self,
        [detections, regions]: &'a [PathBuf; 2],
    ) -> impl Iterator<Item = (PathBuf, &'a WrittenFile)> {
        let of_regions = self.regions.iter().map(move |file| (regions, file));
        std::iter::once((detections, &self.detections))
            .chain(of_regions)
            .map(|(folder, file)| (folder.join(DETECTIONS_FILE), file))
    }

    /// Compares the files of a finished cell with their checksums, before they are read. Text files have none.
    ///
    /// # Errors
    /// A file that was changed.
    pub(crate) fn verify(folders: &[PathBuf; 2]) -> Result<()> {
        let path = folders[0].join("cell.json");
        let cell: Cell = serde_json::from_slice(&fs_err::read(&path)?)?;
        for (file, written) in cell.files.iter().flat_map(|files| files.in_folders(folders)) {
            if file_sha256(&file)? != written.sha256 {
                let message = format!(
                    "was changed after it was written; remove {} and run the study again to detect anew",
                    path.display()
                );
                return Err(DataError::file(&file, message).into());
            }
        }
        Ok(())
    }
}
