//! Why a run cannot begin, go on or end.

use data::DataError;
use models::ModelError;
use std::path::{Path, PathBuf};

/// A run that cannot begin, go on or end.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// A file of the data set, or any file that cannot be read or written.
    #[error(transparent)]
    Data(#[from] DataError),
    /// The network, its weights or a frame that it cannot take.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// A file of the run folder, or the folder as a whole.
    #[error("{path}: {message}")]
    Folder {
        /// The file or folder.
        path: PathBuf,
        /// What is wrong and what to do.
        message: String,
    },
    /// What was asked for cannot be.
    #[error("{0}")]
    Config(String),
    /// The training has diverged, or its data are damaged.
    #[error(
        "step {step}: {what} is not finite; the batch holds the frames {}. The run stops; its last checkpoint is good. \
         Look at these frames with `lidarshift doctor`, or lower optimization.lr_max",
        frames.join(", ")
    )]
    NotFinite {
        /// Counted from 0.
        step: u64,
        /// The loss, or the parameter whose gradient it is.
        what: String,
        /// The frames of the batch.
        frames: Vec<String>,
    },
}

impl From<std::io::Error> for TrainError {
    fn from(error: std::io::Error) -> Self {
        TrainError::Data(error.into())
    }
}

impl TrainError {
    pub(crate) fn folder(path: &Path, message: impl Into<String>) -> Self {
        TrainError::Folder { path: path.into(), message: message.into() }
    }
}
