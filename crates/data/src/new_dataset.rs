//! Writes a new data set: folder, manifest, frames, splits and `dataset.toml`.

use crate::Presence as _;
use crate::frame_records::FrameRecords;
use crate::limits::read_text;
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

    /// Sets the SHA-256 of `frames.jsonl`, which has those of all frames, and the builds of the program that wrote the
    /// frames.
    fn set_frames(&mut self, sha256: String, builds: Vec<String>);
}

/// Makes a struct with the fields `schema`, `config_sha256`, `complete`, `frames_sha256` and `builds` a [`Manifest`];
/// the second argument is [`Manifest::DIFFERENCE`].
#[macro_export]
macro_rules! manifest {
    ($name:ident, $difference:literal) => {
        impl $crate::Manifest for $name {
            const DIFFERENCE: &'static str = $difference;

            fn identity(&self) -> [&str; 2] {
                [&self.schema, &self.config_sha256]
            }

            fn set_complete(&mut self, complete: bool) {
                self.complete = complete;
            }

            fn set_frames(&mut self, sha256: String, builds: Vec<String>) {
                (self.frames_sha256, self.builds) = (sha256, builds);
            }
        }
    };
}

/// A data set that is being written. Frames that an earlier run with the same manifest wrote are kept. Its folder is
/// locked against other processes while this value lives.
pub struct NewDataset<'a> {
    root: &'a Path,
    layout: Layout,
    records: FrameRecords,
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
        let lock = FolderLock::acquire(root)?;
        let of_frames = layout.folders().iter().chain(extra_folders).filter(|inside| !inside.is_empty());
        check_folder(root, manifest, &of_frames.map(|inside| root.join(inside)).collect::<Vec<_>>())?;
        for inside in ["ImageSets"].iter().chain(layout.folders()).chain(extra_folders) {
            remove_unfinished(&root.join(inside))?;
        }
        manifest.set_complete(false);
        write_json(&manifest_path(root), manifest)?;
        Ok(NewDataset { root, layout, records: FrameRecords::open(root)?, _lock: lock })
    }

    /// Writes the records of the frames `ids`, marks the data set as complete and writes the manifest.
    pub fn finish<M: Manifest>(&self, manifest: &mut M, ids: &[String]) -> Result<(), DataError> {
        let finished = self.records.finish(ids)?;
        manifest.set_frames(finished.sha256, finished.builds);
        manifest.set_complete(true);
        write_json(&manifest_path(self.root), manifest)
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

    /// Makes a frame by `make`, unless its files are there as they were written and it was made from the same
    /// `source` (a SHA-256). `files` gives its files after it was made.
    pub fn frame<E: From<DataError>>(
        &self,
        id: &str,
        source: Option<&str>,
        files: impl Fn() -> Vec<PathBuf>,
        make: impl FnOnce() -> Result<(), E>,
    ) -> Result<(), E> {
        if !self.records.is_whole(id, source, &files()) {
            make()?;
            self.records.add(id, source, &files())?;
        }
        Ok(())
    }

    /// As [`Self::frame`], for a file with several frames whose record has the name `name`. `read` reads what the
    /// frames are made from, and `write` does so and writes the file. Both return the SHA-256 of what they read, and
    /// counts of it.
    pub fn file_of_frames<T, E: From<DataError>>(
        &self,
        name: &str,
        file: &Path,
        read: impl FnOnce() -> Result<(String, T), E>,
        write: impl FnOnce() -> Result<(String, T), E>,
    ) -> Result<T, E> {
        let files = [file.to_path_buf()];
        if self.records.has(name) && file.may_be_file() {
            let (source, counts) = read()?;
            if self.records.is_whole(name, Some(&source), &files) {
                return Ok(counts);
            }
        }
        let (source, counts) = write()?;
        self.records.add(name, Some(&source), &files)?;
        Ok(counts)
    }

    /// Number of points and of labels of a written frame.
    pub fn count(&self, id: &str, columns: PointColumns) -> Result<[usize; 2], DataError> {
        let points = self.layout.count_points(self.root, id, columns)?;
        Ok([points, self.layout.read_labels(self.root, id)?.len()])
    }
}

fn manifest_path(root: &Path) -> PathBuf {
    root.join("manifest.json")
}

/// An error if the folder has another data set. A manifest without any frame is that of a process that failed before
/// it wrote one, perhaps because it could not read all of its source. `of_frames` are the folders of frames.
fn check_folder<M: Manifest>(root: &Path, wanted: &M, of_frames: &[PathBuf]) -> Result<(), DataError> {
    let path = manifest_path(root);
    if path.may_be_file() {
        let text = read_text(&path)?;
        let found: M = serde_json::from_str(&text).map_err(|e| DataError::line(&path, e.line(), e.to_string()))?;
        let is_begun = || !FrameRecords::is_empty(root) || of_frames.iter().any(|folder| has_files(folder));
        if found.identity() != wanted.identity() && is_begun() {
            let message = format!("was made {}; choose another folder, or remove this one", M::DIFFERENCE);
            return Err(DataError::file(root, message));
        }
    } else if !is_unused(root)? {
        return Err(DataError::file(root, "is not empty and has no manifest.json; choose another folder"));
    }
    Ok(())
}

/// Whether a folder holds anything; false if it does not exist.
fn has_files(folder: &Path) -> bool {
    folder.may_be_folder() && fs_err::read_dir(folder).map_or(true, |mut entries| entries.next().is_some())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Cloud, Dataset, FRAMES_FILE, Frame, verify_frames};
    use serde::Deserialize;

    #[derive(Serialize, Deserialize)]
    struct Made {
        complete: bool,
        sha: String,
        frames_sha256: String,
        builds: Vec<String>,
    }

    impl Manifest for Made {
        const DIFFERENCE: &'static str = "with another recipe";

        fn identity(&self) -> [&str; 2] {
            ["made/1", &self.sha]
        }

        fn set_complete(&mut self, complete: bool) {
            self.complete = complete;
        }

        fn set_frames(&mut self, sha256: String, builds: Vec<String>) {
            (self.frames_sha256, self.builds) = (sha256, builds);
        }
    }

    fn make(root: &Path, sha: &str) -> Result<usize, DataError> {
        make_from(root, sha, "source")
    }

    /// Returns the number of frames that were made.
    fn make_from(root: &Path, sha: &str, source: &str) -> Result<usize, DataError> {
        let mut manifest = Made { complete: true, sha: sha.into(), frames_sha256: String::new(), builds: vec![] };
        let set = NewDataset::begin(root, Layout::Kitti, &[], &mut manifest)?;
        let ids = ["a", "b"].map(String::from);
        set.describe(DatasetConfig { name: "made".into(), ..DatasetConfig::default() }, [("train", ids.to_vec())])?;
        let written = set.make_frames(&ids, &|_, _| (), |_, id| {
            let layout = set.layout();
            let files = || vec![layout.cloud_path(root, id), layout.labels_path(root, id)];
            let mut made = 0;
            set.frame(id, Some(source), files, || {
                made += 1;
                let cloud = Cloud { values: vec![1.0; 8], channels: 4 };
                layout.write_frame(root, &Frame { id: id.clone(), cloud, objects: vec![] })
            })?;
            assert_eq!(set.count(id, PointColumns::Xyzi)?, [2, 0]);
            Ok::<usize, DataError>(made)
        })?;
        set.finish(&mut manifest, &ids)?;
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
        assert_eq!(make(&root, "1").unwrap(), 0);
        std::fs::remove_file(root.join("manifest.json")).unwrap();
        assert!(make(&root, "1").unwrap_err().to_string().contains("is not empty"));
        // A process that failed before its first frame.
        let failed = folder.path().join("failed");
        let mut manifest = Made { complete: true, sha: "2".into(), frames_sha256: String::new(), builds: vec![] };
        drop(NewDataset::begin(&failed, Layout::Kitti, &[], &mut manifest).unwrap());
        assert_eq!(make(&failed, "1").unwrap(), 2);
        assert!(NewDataset::begin(&failed, Layout::Kitti, &[], &mut manifest).is_err());
        let failed = folder.path().join("begun");
        drop(NewDataset::begin(&failed, Layout::Kitti, &[], &mut manifest).unwrap());
        std::fs::create_dir(failed.join("velodyne")).unwrap();
        std::fs::write(failed.join("velodyne/z.bin"), "a frame without its record").unwrap();
        assert!(make(&failed, "1").unwrap_err().to_string().contains("was made with another recipe"));
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

    #[test]
    fn manifests_name_the_builds_of_their_frames() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("set");
        let builds = || {
            make(&root, "1").unwrap();
            let text = std::fs::read(root.join("manifest.json")).unwrap();
            serde_json::from_slice::<Made>(&text).unwrap().builds
        };
        assert_eq!(builds(), [crate::build_id()]);
        // Both frames from another build, one of which is lost.
        let path = root.join(FRAMES_FILE);
        let records = std::fs::read_to_string(&path).unwrap();
        std::fs::write(&path, records.replace(crate::build_id(), "0.0.1+other")).unwrap();
        std::fs::remove_file(root.join("velodyne/b.bin")).unwrap();
        assert_eq!(builds(), ["0.0.1+other", crate::build_id()]);
    }

    #[test]
    fn changed_frames_are_made_again() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("set");
        make(&root, "1").unwrap();
        let records = std::fs::read_to_string(root.join(FRAMES_FILE)).unwrap();
        assert_eq!(verify_frames(&root).unwrap(), 2);
        let cloud = root.join("velodyne/b.bin");
        let bytes = std::fs::read(&cloud).unwrap();
        for damaged in [vec![], [&bytes[..31], &[1]].concat(), vec![0; bytes.len()]] {
            std::fs::write(&cloud, damaged).unwrap();
            let error = verify_frames(&root).unwrap_err().to_string();
            assert!(
                error.contains("1 files are missing or were changed") && error.contains("velodyne/b.bin"),
                "{error}"
            );
            assert_eq!(make(&root, "1").unwrap(), 1);
            assert_eq!(std::fs::read(&cloud).unwrap(), bytes);
        }
        assert_eq!(make_from(&root, "1", "another source").unwrap(), 2);
        assert_eq!(make(&root, "1").unwrap(), 2);
        // A record that is lost or torn by a kill: its frame is made again.
        std::fs::write(root.join(FRAMES_FILE), &records[..records.len() - 20]).unwrap();
        assert!(verify_frames(&root).unwrap_err().to_string().contains(FRAMES_FILE));
        assert_eq!(make(&root, "1").unwrap(), 1);
        assert_eq!(std::fs::read_to_string(root.join(FRAMES_FILE)).unwrap(), records);
    }
}
