//! Errors of data sets. Messages name the file and, for text, the line.

use std::path::{Path, PathBuf};

/// A data set or a file that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum DataError {
    /// The file could not be read or written. The message has the path, from `fs-err`.
    #[error(transparent)]
    Io(#[from] std::io::Error),
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
    /// A file as a whole is invalid.
    #[error("{path}: {message}")]
    File {
        /// The file.
        path: PathBuf,
        /// What is invalid and how to correct it.
        message: String,
    },
}

impl DataError {
    /// An error of one line of `path`, counted from 1.
    pub fn line(path: &Path, line: usize, message: impl Into<String>) -> Self {
        DataError::Line { path: path.into(), line, message: message.into() }
    }

    /// An error of `path` as a whole.
    pub fn file(path: &Path, message: impl Into<String>) -> Self {
        DataError::File { path: path.into(), message: message.into() }
    }
}
