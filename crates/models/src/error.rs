//! What can be wrong with a network, its file or its input.

use std::path::PathBuf;

/// A detector that cannot be built, loaded or run.
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
    /// A frame that the network cannot take.
    #[error("frame {id}: {message}")]
    Frame {
        /// Its id.
        id: String,
        /// What is wrong and what to do.
        message: String,
    },
    /// A value that is not a number, or infinite, where the network should give numbers.
    #[error("{0}")]
    NonFinite(String),
    /// A tensor that does not hold what it should.
    #[error("tensor: {0}")]
    Tensor(String),
}
