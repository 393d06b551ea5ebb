//! Errors of data sets. Messages name the file and, for text, the line.

use crate::place::ErrorKind;
use std::io;
use std::path::{Path, PathBuf};

/// A data set or a file that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum DataError {
    /// The file could not be read or written. The message has the path, from `fs-err`.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// One line of a text file is invalid.
    #[error("{path}:{line}: {message}")]
    Line {
        /// The file.
        path: PathBuf,
        /// The line, counted from 1.
        line: usize,
        /// What is invalid and how to correct it.
        message: String,
    },
    /// A file or folder as a whole cannot be used.
    #[error("{path}: {message}")]
    File {
        /// The file.
        path: PathBuf,
        /// Why it cannot be used.
        kind: ErrorKind,
        /// What is invalid and how to correct it.
        message: String,
    },
}

impl DataError {
    /// An error of one line of `path`, counted from 1.
    pub fn line(path: &Path, line: usize, message: impl Into<String>) -> Self {
        DataError::Line { path: path.into(), line, message: message.into() }
    }

    /// An error of `path` as a whole: its content is invalid.
    pub fn file(path: &Path, message: impl Into<String>) -> Self {
        Self::of_kind(ErrorKind::Invalid, path, message)
    }

    /// An error of `path`, which does not exist.
    pub fn missing(path: &Path, message: impl Into<String>) -> Self {
        Self::of_kind(ErrorKind::Missing, path, message)
    }

    /// An error of this kind of `path` as a whole.
    pub fn of_kind(kind: ErrorKind, path: &Path, message: impl Into<String>) -> Self {
        DataError::File { path: path.into(), kind, message: message.into() }
    }

    /// An error of the file system on `path`: `failed` says what failed, such as "cannot be written".
    pub fn io(path: &Path, failed: &str, error: &io::Error) -> Self {
        Self::of_kind(error.kind().into(), path, format!("{failed}: {error}"))
    }
}
