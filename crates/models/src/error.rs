//! Errors of networks, their files and their inputs.

use data::{ErrorKind, Located, Place};
use std::path::PathBuf;

/// An error of a detector.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// A file of the data set, or any file that cannot be read or written.
    #[error(transparent)]
    Data(#[from] data::DataError),
    /// A checkpoint, configuration or reference file that is wrong.
    #[error("{path}: {message}")]
    File {
        /// The file.
        path: PathBuf,
        /// What is wrong and what to do.
        message: String,
    },
    /// Weights that do not fit the network.
    #[error("{0}")]
    Weights(String),
    /// A frame that the network cannot read.
    #[error("frame {id}: {message}")]
    Frame {
        /// Its id.
        id: String,
        /// What is wrong and what to do.
        message: String,
    },
    /// An output of the network that is NaN or infinite.
    #[error("{0}")]
    NonFinite(String),
    /// A tensor of an unexpected type or kind.
    #[error("tensor: {0}")]
    Tensor(String),
}

impl Located for ModelError {
    fn place(&self) -> Place {
        match self {
            ModelError::Data(error) => error.place(),
            ModelError::File { path, .. } => Place::in_file(ErrorKind::Invalid, path),
            ModelError::NonFinite(_) => Place::of_kind(ErrorKind::NotFinite),
            ModelError::Weights(_) | ModelError::Frame { .. } | ModelError::Tensor(_) => {
                Place::of_kind(ErrorKind::Invalid)
            }
        }
    }
}
