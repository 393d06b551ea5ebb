//! Whether files exist, on file systems that may fail to say so.

use crate::source::is_url;
use std::io::ErrorKind;
use std::path::Path;

/// Whether a path exists, with the answer "maybe" where the file system does not answer. `Path::is_file` answers "no"
/// to every error, such as ESTALE of a network file system, and what is there would be left out silently. After "maybe"
/// the file is opened, and the error is reported or gone.
pub trait Presence {
    /// Whether this is a file; true if the file system does not answer.
    fn may_be_file(&self) -> bool;

    /// Whether this is a folder; true if the file system does not answer.
    fn may_be_folder(&self) -> bool;

    /// Whether this exists; true if the file system does not answer.
    fn may_exist(&self) -> bool;
}

impl Presence for Path {
    fn may_be_file(&self) -> bool {
        if is_url(self) {
            return may_be_object(self);
        }
        self.metadata().map_or_else(is_unknown, |found| found.is_file())
    }

    fn may_be_folder(&self) -> bool {
        if is_url(self) {
            return may_be_prefix(self);
        }
        self.metadata().map_or_else(is_unknown, |found| found.is_dir())
    }

    fn may_exist(&self) -> bool {
        if is_url(self) {
            return may_be_object(self) || may_be_prefix(self);
        }
        self.metadata().map_or_else(is_unknown, |_| true)
    }
}

#[cfg(feature = "store")]
fn may_be_object(url: &Path) -> bool {
    crate::store::is_object(url).unwrap_or(true)
}

#[cfg(feature = "store")]
fn may_be_prefix(url: &Path) -> bool {
    crate::store::is_prefix(url).unwrap_or(true)
}

/// Reading it is the error that says what is missing.
#[cfg(not(feature = "store"))]
fn may_be_object(_: &Path) -> bool {
    true
}

#[cfg(not(feature = "store"))]
fn may_be_prefix(_: &Path) -> bool {
    true
}

#[expect(clippy::needless_pass_by_value, reason = "the form that `map_or_else` takes")]
fn is_unknown(error: std::io::Error) -> bool {
    use ErrorKind::{InvalidFilename, InvalidInput, NotADirectory, NotFound};
    !matches!(error.kind(), NotFound | NotADirectory | InvalidFilename | InvalidInput)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn absent_is_not_unknown() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("file");
        std::fs::write(&file, "").unwrap();
        let answers = |path: &Path| [path.may_be_file(), path.may_be_folder(), path.may_exist()];
        assert_eq!(answers(&file), [true, false, true]);
        assert_eq!(answers(folder.path()), [false, true, true]);
        for absent in ["none", "file/none", &"long".repeat(200), "nul\0"] {
            assert_eq!(answers(&folder.path().join(absent)), [false; 3], "{absent}");
        }
        #[cfg(unix)]
        {
            // A loop of links is an error that says nothing about a file.
            std::os::unix::fs::symlink("loop", folder.path().join("loop")).unwrap();
            assert_eq!(answers(&folder.path().join("loop")), [true; 3]);
        }
    }
}
