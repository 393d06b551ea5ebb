//! What can be wrong with a file, said with the file's name and, for text, its line.

use std::path::{Path, PathBuf};

/// A data set, or one file of it, that cannot be used as it is.
#[derive(Debug, thiserror::Error)]
pub enum DataError {
    /// The file could not be read or written; `fs-err` puts the path into the message.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// One line of a text file is wrong.
    #[error("{path}:{line}: {message}")]
    Line {
        /// The file.
        path: PathBuf,
        /// Counted from 1.
        line: usize,
        /// What is wrong and what to do.
        message: String,
    },
    /// A file as a whole is wrong.
    #[error("{path}: {message}")]
    File {
        /// The file.
        path: PathBuf,
        /// What is wrong and what to do.
        message: String,
    },
}

impl DataError {
    /// One line of `path` is wrong.
    pub fn line(path: &Path, line: usize, message: impl Into<String>) -> Self {
        DataError::Line { path: path.into(), line, message: message.into() }
    }

    /// `path` as a whole is wrong.
    pub fn file(path: &Path, message: impl Into<String>) -> Self {
        DataError::File { path: path.into(), message: message.into() }
    }
}
