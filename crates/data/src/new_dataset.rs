//! Writes a new data set: folder, manifest, frames, splits and `dataset.toml`.

use crate::output::remove_unfinished;
use crate::write::{write_dataset_toml, write_split};
use crate::{DataError, DatasetConfig, FolderLock, Layout, PointColumns, is_unused, write_json};
use rayon::prelude::*;
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

/// The `manifest.json` of a generated data set.
pub trait Manifest: Serialize + DeserializeOwned {
    /// What differs if the folder has another data set. Completes the error message "was made ...".
    const DIFFERENCE: &'static str;

    /// Version of the manifest and hash of everything that determines the frames.
    fn identity(&self) -> [&str; 2];

    /// Sets whether all frames are written.
    fn set_complete(&mut self, complete: bool);
}

/// A data set that is being written. Frames that an earlier run with the same manifest wrote are kept. Its folder is
/// locked against other processes while this value lives.
pub struct NewDataset<'a> {
    root: &'a Path,
    layout: Layout,
    _lock: FolderLock,
}

impl<'a> NewDataset<'a> {
    /// Begins or resumes a data set in the folder `root`.
    ///
    /// `root` must be empty, not exist, or have a manifest with the same identity. `extra_folders` are further folders,
    /// relative to `root`, into which the caller writes. Incomplete files in all these folders are removed. A folder
    /// that another process writes is refused.
    pub fn begin<M: Manifest>(
        root: &'a Path,
        layout: Layout,
        extra_folders: &[&str],
        manifest: &mut M,
    ) -> Result<Self, DataError> {
        let set = NewDataset { root, layout, _lock: FolderLock::acquire(root)? };
        set.check_folder(manifest)?;
        for inside in ["ImageSets"].iter().chain(layout.folders()).chain(extra_folders) {
            remove_unfinished(&root.join(inside))?;
        }
        manifest.set_complete(false);
        write_json(&set.manifest_path(), manifest)?;
        Ok(set)
    }

    /// Marks the data set as complete and writes the manifest.
    pub fn finish<M: Manifest>(&self, manifest: &mut M) -> Result<(), DataError> {
        manifest.set_complete(true);
        write_json(&self.manifest_path(), manifest)
    }

    /// The root folder.
    pub fn root(&self) -> &Path {
        self.root
    }

    /// The layout of the files.
    pub fn layout(&self) -> Layout {
        self.layout
    }

    /// Writes the splits and `dataset.toml`. Root, layout and splits of `config` are replaced by those of this data
    /// set.
    pub fn describe<N: AsRef<str>>(
        &self,
        config: DatasetConfig,
        splits: impl IntoIterator<Item = (N, Vec<String>)>,
    ) -> Result<(), DataError> {
        let mut config = DatasetConfig { root: ".".into(), layout: self.layout, splits: Default::default(), ..config };
        for (name, ids) in splits {
            let list = PathBuf::from(format!("ImageSets/{}.txt", name.as_ref()));
            write_split(&self.root.join(&list), &ids)?;
            config.splits.insert(name.as_ref().into(), list);
        }
        write_dataset_toml(&self.root.join("dataset.toml"), &config)
    }

    /// Calls `make` for all frames in parallel. Results are in the order of the frames.
    ///
    /// `progress` is called with the number of finished frames and of all frames, from several threads.
    pub fn make_frames<K: Sync, T: Send, E: Send>(
        &self,
        frames: &[K],
        progress: &(dyn Fn(usize, usize) + Sync),
        make: impl Fn(usize, &K) -> Result<T, E> + Sync,
    ) -> Result<Vec<T>, E> {
        let done = AtomicUsize::new(0);
        progress(0, frames.len());
        let made = frames.par_iter().enumerate().map(|(i, frame)| {
            let made = make(i, frame)?;
            progress(done.fetch_add(1, Ordering::Relaxed) + 1, frames.len());
            Ok(made)
        });
        made.collect()
    }

    /// Whether a frame is written, with its labels if `labelled`.
    pub fn has_frame(&self, id: &str, labelled: bool) -> bool {
        self.layout.has_cloud(self.root, id) && (!labelled || self.layout.labels_path(self.root, id).is_file())
    }

    /// Number of points and of labels of a written frame.
    pub fn count(&self, id: &str, columns: PointColumns) -> Result<[usize; 2], DataError> {
        let points = self.layout.count_points(self.root, id, columns)?;
        Ok([points, self.layout.read_labels(self.root, id)?.len()])
    }

    fn manifest_path(&self) -> PathBuf {
        self.root.join("manifest.json")
    }

    fn check_folder<M: Manifest>(&self, wanted: &M) -> Result<(), DataError> {
        let path = self.manifest_path();
        if path.is_file() {
            let text = fs_err::read_to_string(&path)?;
            let found: M = serde_json::from_str(&text).map_err(|e| DataError::line(&path, e.line(), e.to_string()))?;
            if found.identity() != wanted.identity() {
                let message = format!("was made {}; choose another folder, or remove this one", M::DIFFERENCE);
                return Err(DataError::file(self.root, message));
            }
        } else if !is_unused(self.root)? {
            return Err(DataError::file(self.root, "is not empty and has no manifest.json; choose another folder"));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Cloud, Dataset, Frame};
    use serde::Deserialize;

    #[derive(Serialize, Deserialize)]
    struct Made {
        complete: bool,
        sha: String,
    }

    impl Manifest for Made {
        const DIFFERENCE: &'static str = "with another recipe";

        fn identity(&self) -> [&str; 2] {
            ["made/1", &self.sha]
        }

        fn set_complete(&mut self, complete: bool) {
            self.complete = complete;
        }
    }

    fn make(root: &Path, sha: &str) -> Result<usize, DataError> {
        let mut manifest = Made { complete: true, sha: sha.into() };
        let set = NewDataset::begin(root, Layout::Kitti, &[], &mut manifest)?;
        let ids = ["a", "b"].map(String::from);
        set.describe(DatasetConfig { name: "made".into(), ..DatasetConfig::default() }, [("train", ids.to_vec())])?;
        let written = set.make_frames(&ids, &|_, _| (), |_, id| {
            let there = set.has_frame(id, true);
            if !there {
                let cloud = Cloud { values: vec![1.0; 8], channels: 4 };
                set.layout().write_frame(root, &Frame { id: id.clone(), cloud, objects: vec![] })?;
            }
            assert_eq!(set.count(id, PointColumns::Xyzi)?, [2, 0]);
            Ok::<usize, DataError>(usize::from(!there))
        })?;
        set.finish(&mut manifest)?;
        assert!(manifest.complete);
        Ok(written.iter().sum())
    }

    #[test]
    fn an_interrupted_run_is_resumed_and_other_folders_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("set");
        assert_eq!(make(&root, "1").unwrap(), 2);
        assert_eq!(Dataset::open(&root).unwrap().ids("train").unwrap(), ["a", "b"]);
        std::fs::remove_file(root.join("velodyne/b.bin")).unwrap();
        assert_eq!(make(&root, "1").unwrap(), 1);
        let error = make(&root, "2").unwrap_err().to_string();
        assert!(error.contains("was made with another recipe; choose another folder"), "{error}");
        std::fs::remove_file(root.join("manifest.json")).unwrap();
        assert!(make(&root, "1").unwrap_err().to_string().contains("is not empty"));
        // A process that was killed before its first manifest.
        let killed = folder.path().join("killed");
        std::fs::create_dir(&killed).unwrap();
        std::fs::write(killed.join(".writing-abc"), "half").unwrap();
        std::fs::write(killed.join(".lock"), "process 1").unwrap();
        assert_eq!(make(&killed, "1").unwrap(), 2);
        assert!(!killed.join(".writing-abc").exists());
        let lock = FolderLock::acquire(&root).unwrap();
        assert!(make(&root, "1").unwrap_err().to_string().contains("in use by another process"));
        drop(lock);
    }
}
