//! The lock of an output folder. Every writer of a folder takes it before it looks at what the folder holds.

use crate::output::{TEMPORARY_PREFIX, create_folder, remove_unfinished};
use crate::{DataError, ErrorKind};
use std::fs::{File, TryLockError};
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Name of the file that is locked.
const LOCK: &str = ".lock";

/// Attempts to take a lock, and the time between them. [`FolderLock::is_held`] of another process holds a lock for a
/// moment.
const ATTEMPTS: (usize, Duration) = (20, Duration::from_millis(10));

/// A folder that is locked against other processes while this value lives. The file of the lock is removed with it.
#[derive(Debug)]
pub struct FolderLock {
    path: PathBuf,
    file: File,
}

impl FolderLock {
    /// Locks a folder, creates it if it does not exist, and removes temporary files of killed processes from it.
    ///
    /// # Errors
    /// A folder in use by another process, or one that cannot be written.
    pub fn acquire(folder: &Path) -> Result<FolderLock, DataError> {
        match Self::acquire_as(folder, LOCK)? {
            Some(lock) => {
                remove_unfinished(folder)?;
                Ok(lock)
            }
            None => {
                let owner = fs_err::read_to_string(folder.join(LOCK)).unwrap_or_default();
                let owner = if owner.is_empty() { String::new() } else { format!(" ({})", owner.trim()) };
                let message =
                    format!("is in use by another process{owner}; wait until it ends, or choose another --out");
                Err(DataError::of_kind(ErrorKind::InUse, folder, message))
            }
        }
    }

    /// Locks the file `name` of a folder, for one kind of writers among others; `None` if another process holds it.
    ///
    /// # Errors
    /// A folder that cannot be written.
    pub fn acquire_as(folder: &Path, name: &str) -> Result<Option<FolderLock>, DataError> {
        create_folder(folder)?;
        let path = folder.join(name);
        for _ in 0..ATTEMPTS.0 {
            let file = open(&path)?;
            match file.try_lock() {
                Ok(()) => {}
                // A file system without locks.
                Err(TryLockError::Error(e)) if e.kind() == std::io::ErrorKind::Unsupported => {}
                Err(TryLockError::WouldBlock) => {
                    std::thread::sleep(ATTEMPTS.1);
                    continue;
                }
                Err(TryLockError::Error(e)) => {
                    return Err(DataError::io(&path, "cannot be locked", &e));
                }
            }
            // Otherwise its owner has removed it between opening and locking.
            if is_same(&file, &path) {
                let lock = FolderLock { path, file };
                let failed = |e| DataError::io(&lock.path, "cannot be written", &e);
                lock.write_owner().map_err(failed)?;
                return Ok(Some(lock));
            }
        }
        Ok(None)
    }

    /// As [`Self::acquire_as`], but waits until the lock is free.
    ///
    /// # Errors
    /// A folder that cannot be written.
    pub fn wait_for(folder: &Path, name: &str) -> Result<FolderLock, DataError> {
        loop {
            if let Some(lock) = Self::acquire_as(folder, name)? {
                return Ok(lock);
            }
        }
    }

    /// Whether a process holds the lock `name` of a folder.
    pub fn is_held(folder: &Path, name: &str) -> bool {
        let Ok(file) = File::options().write(true).open(folder.join(name)) else { return false };
        matches!(file.try_lock_shared(), Err(TryLockError::WouldBlock))
    }

    fn write_owner(&self) -> std::io::Result<()> {
        let mut file = &self.file;
        file.set_len(0)?;
        file.write_all(format!("process {}", std::process::id()).as_bytes())
    }
}

impl Drop for FolderLock {
    fn drop(&mut self) {
        // Removed while it is locked. An error leaves a file that the next process locks, and closing it releases the
        // lock in any case.
        if cfg!(unix) && is_same(&self.file, &self.path) {
            std::fs::remove_file(&self.path).ok();
        }
        self.file.unlock().ok();
    }
}

fn open(path: &Path) -> Result<File, DataError> {
    let mut options = fs_err::OpenOptions::new();
    Ok(options.read(true).write(true).create(true).truncate(false).open(path)?.into_file())
}

/// Whether `path` still names the open file.
#[cfg(unix)]
fn is_same(file: &File, path: &Path) -> bool {
    use std::os::unix::fs::MetadataExt as _;
    let id = |metadata: std::fs::Metadata| (metadata.dev(), metadata.ino());
    matches!((file.metadata().map(id), std::fs::metadata(path).map(id)), (Ok(a), Ok(b)) if a == b)
}

#[cfg(not(unix))]
fn is_same(_file: &File, _path: &Path) -> bool {
    true
}

/// Whether a folder holds nothing but locks and temporary files.
///
/// # Errors
/// A folder that cannot be read.
pub fn is_unused(folder: &Path) -> Result<bool, DataError> {
    for entry in fs_err::read_dir(folder)? {
        let name = entry?.file_name();
        if name != LOCK && !name.to_string_lossy().starts_with(TEMPORARY_PREFIX) {
            return Ok(false);
        }
    }
    Ok(true)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_writer_at_a_time_and_no_file_afterwards() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("new");
        let lock = FolderLock::acquire(&root).unwrap();
        let error = FolderLock::acquire(&root).unwrap_err().to_string();
        assert!(error.contains("new: is in use by another process (process "), "{error}");
        assert!(FolderLock::is_held(&root, LOCK) && is_unused(&root).unwrap());
        let other = FolderLock::acquire_as(&root, ".other").unwrap();
        assert!(other.is_some() && !is_unused(&root).unwrap());
        drop((lock, other));
        assert!(!FolderLock::is_held(&root, LOCK));
        #[cfg(unix)]
        assert_eq!(std::fs::read_dir(&root).unwrap().count(), 0);
        // Files of a killed process.
        std::fs::write(root.join(LOCK), "process 1").unwrap();
        std::fs::write(root.join(".writing-abc"), "half").unwrap();
        assert!(is_unused(&root).unwrap());
        FolderLock::acquire(&root).unwrap();
        assert!(!root.join(".writing-abc").exists());
    }

    #[test]
    fn a_lock_is_held_by_one_of_many_threads() {
        let folder = tempfile::tempdir().unwrap();
        let inside = std::sync::atomic::AtomicUsize::new(0);
        std::thread::scope(|scope| {
            for _ in 0..4 {
                scope.spawn(|| {
                    for _ in 0..50 {
                        let _lock = FolderLock::wait_for(folder.path(), LOCK).unwrap();
                        assert_eq!(inside.fetch_add(1, std::sync::atomic::Ordering::SeqCst), 0);
                        inside.fetch_sub(1, std::sync::atomic::Ordering::SeqCst);
                    }
                });
            }
        });
    }
}
