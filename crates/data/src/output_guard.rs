//! Refuses output folders in which files of the input would be overwritten.

use crate::Presence as _;
use crate::{DataError, Dataset, ErrorKind};
use std::path::{Component, Path, PathBuf};

impl Dataset {
    /// Refuses an output folder that is one of the folders of this data set's frames, or inside one: clouds, labels,
    /// calibrations, splits. Symbolic links and `..` are followed.
    ///
    /// # Errors
    /// Such a folder; the message names it.
    pub fn refuse_frame_folder(&self, out: &Path) -> Result<(), DataError> {
        let id = "frame";
        let files = [self.cloud_path(id), self.labels_path(id), self.config.root.join("ImageSets/frame")];
        let beside = self.calibration_path(id).into_iter().chain(self.true_labels_path(id));
        let repaired = self.repaired_labels_paths(id).into_iter().flatten();
        let resolved_out = resolved(out);
        for file in files.into_iter().chain(beside).chain(repaired) {
            let Some(folder) = file.parent().map(resolved) else { continue };
            // A layout with all its files in the root has no folder of its own.
            if resolved_out.starts_with(&folder) {
                let message = format!(
                    "is a folder of the data set {}, whose files would be overwritten; choose another --out",
                    self.config.root.display()
                );
                return Err(DataError::of_kind(ErrorKind::Refused, out, message));
            }
        }
        Ok(())
    }

    /// As [`Self::refuse_frame_folder`], and refuses the root folder of the data set.
    ///
    /// # Errors
    /// Such a folder; the message names it.
    pub fn refuse_own_folder(&self, out: &Path) -> Result<(), DataError> {
        if resolved(out) == resolved(&self.config.root) {
            let message = "is the folder of the data set that is read; choose another --out";
            return Err(DataError::of_kind(ErrorKind::Refused, out, message));
        }
        self.refuse_frame_folder(out)
    }
}

/// Refuses an output file that is one of the files which are read.
///
/// # Errors
/// Such a file; the message names it.
pub fn refuse_input_file<'a>(out: Option<&Path>, inputs: impl IntoIterator<Item = &'a Path>) -> Result<(), DataError> {
    let Some(out) = out.filter(|out| out.may_be_file()) else { return Ok(()) };
    match inputs.into_iter().find(|input| resolved(input) == resolved(out)) {
        Some(_) => Err(DataError::of_kind(
            ErrorKind::Refused,
            out,
            "is a file that is read, and would be overwritten; choose another file",
        )),
        None => Ok(()),
    }
}

/// The absolute path without symbolic links, of a file or folder that need not exist.
fn resolved(path: &Path) -> PathBuf {
    let absolute = std::path::absolute(path).unwrap_or_else(|_| path.to_path_buf());
    let mut found = PathBuf::new();
    // One part after the other, since `..` after a symbolic link leads out of the link's target.
    for part in absolute.components() {
        match part {
            Component::ParentDir => drop(found.pop()),
            Component::CurDir => {}
            part => {
                found.push(part);
                found = found.canonicalize().unwrap_or(found);
            }
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Cloud, Frame, Layout};

    #[test]
    fn folders_of_frames_are_refused_by_any_name() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("set");
        let cloud = Cloud { values: vec![1.0; 8], channels: 4 };
        Layout::Kitti.write_frame(&root, &Frame { id: "a".into(), cloud, objects: vec![] }).unwrap();
        let set = Dataset::open(&root).unwrap();
        for inside in
            ["set/label_2", "set/velodyne", "set/calib", "set/ImageSets", "set/label_2/new", "set/x/../label_2"]
        {
            let error = set.refuse_frame_folder(&folder.path().join(inside)).unwrap_err().to_string();
            assert!(error.contains("would be overwritten"), "{error}");
        }
        for apart in ["set", "set/found", "set/label_2/../found", "set/label_20", "other/label_2"] {
            set.refuse_frame_folder(&folder.path().join(apart)).unwrap();
        }
        assert!(set.refuse_own_folder(&root.join(".")).is_err() && set.refuse_own_folder(&root.join("found")).is_ok());
        #[cfg(unix)]
        {
            std::os::unix::fs::symlink(root.join("label_2"), folder.path().join("link")).unwrap();
            assert!(set.refuse_frame_folder(&folder.path().join("link")).is_err());
            assert!(set.refuse_frame_folder(&folder.path().join("link/../velodyne")).is_err());
        }
        let labels = root.join("label_2/a.txt");
        assert!(refuse_input_file(Some(&labels), [root.join("x/../label_2/a.txt").as_path()]).is_err());
        assert!(refuse_input_file(Some(&root.join("new")), [labels.as_path()]).is_ok());
    }
}
