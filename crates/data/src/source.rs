//! Bytes of files and of objects in stores, by one reader. A path that begins with `s3://`, `http://` or `https://` is
//! an object.

use crate::DataError;
use crate::limits::length_of_file;
use fs_err::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// Schemes of object stores.
const SCHEMES: [&str; 3] = ["s3://", "http://", "https://"];

/// Whether a path is the address of an object, not of a file.
pub fn is_url(path: &Path) -> bool {
    SCHEMES.iter().any(|scheme| path.as_os_str().as_encoded_bytes().starts_with(scheme.as_bytes()))
}

/// Size of a file or object, and what changes when it is changed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Facts {
    /// Bytes.
    pub bytes: u64,
    /// Time of change.
    pub changed: Option<SystemTime>,
    /// Entity tag of an object.
    pub tag: Option<String>,
}

/// A file or an object that is read from any place.
pub(crate) enum Source {
    /// A regular file.
    File(File),
    /// An object of a store.
    #[cfg(feature = "store")]
    Object(crate::store::ObjectReader),
}

impl Source {
    /// Opens a regular file or an object. Of an object no more than to `end` is asked for at first.
    ///
    /// # Errors
    /// What cannot be opened, or is no regular file.
    pub(crate) fn open(path: &Path, end: Option<u64>) -> Result<Source, DataError> {
        if is_url(path) {
            return Self::open_object(path, end);
        }
        length_of_file(path, u64::MAX)?;
        Ok(Source::File(File::open(path)?))
    }

    #[cfg(feature = "store")]
    fn open_object(path: &Path, end: Option<u64>) -> Result<Source, DataError> {
        Ok(Source::Object(crate::store::ObjectReader::open(path, end)?))
    }

    #[cfg(not(feature = "store"))]
    fn open_object(path: &Path, _end: Option<u64>) -> Result<Source, DataError> {
        Err(without_stores(path))
    }
}

impl Read for Source {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        match self {
            Source::File(file) => file.read(buffer),
            #[cfg(feature = "store")]
            Source::Object(object) => object.read(buffer),
        }
    }
}

impl Seek for Source {
    fn seek(&mut self, to: SeekFrom) -> std::io::Result<u64> {
        match self {
            Source::File(file) => file.seek(to),
            #[cfg(feature = "store")]
            Source::Object(object) => object.seek(to),
        }
    }
}

/// The absolute path of a file or folder; the address of an object as it is.
///
/// # Errors
/// An empty path, and a working directory that is not known.
pub fn absolute(path: &Path) -> std::io::Result<PathBuf> {
    if is_url(path) { Ok(path.into()) } else { std::path::absolute(path) }
}

/// Size and state of a file or an object.
///
/// # Errors
/// What does not exist or cannot be asked for.
pub(crate) fn facts(path: &Path) -> Result<Facts, DataError> {
    if is_url(path) {
        return facts_of_object(path);
    }
    let metadata = fs_err::metadata(path)?;
    Ok(Facts { bytes: metadata.len(), changed: metadata.modified().ok(), tag: None })
}

/// The files or objects in a folder, or with a prefix, that end in `ending` and do not begin with a full stop. An
/// `http` server lists nothing: there the files are those that `index` names.
///
/// # Errors
/// A folder that cannot be listed.
pub(crate) fn list(folder: &Path, ending: &str, index: &str) -> Result<Vec<(PathBuf, Facts)>, DataError> {
    if is_url(folder) {
        return list_objects(folder, ending, index);
    }
    let mut found = Vec::new();
    for entry in fs_err::read_dir(folder)? {
        let path = entry?.path();
        let is_hidden = path.file_name().is_some_and(|name| name.as_encoded_bytes().starts_with(b"."));
        if path.extension().is_some_and(|e| e == ending) && !is_hidden {
            let facts = facts(&path)?;
            found.push((path, facts));
        }
    }
    Ok(found)
}

#[cfg(feature = "store")]
use crate::store::{facts as facts_of_object, list as list_objects};

#[cfg(not(feature = "store"))]
fn facts_of_object(path: &Path) -> Result<Facts, DataError> {
    Err(without_stores(path))
}

#[cfg(not(feature = "store"))]
fn list_objects(folder: &Path, _ending: &str, _index: &str) -> Result<Vec<(PathBuf, Facts)>, DataError> {
    Err(without_stores(folder))
}

#[cfg(not(feature = "store"))]
fn without_stores(path: &Path) -> DataError {
    let message = "is in an object store, which this program was built without: build it with `--features store`, or copy \
                   the data set to a folder";
    DataError::file(path, message)
}
