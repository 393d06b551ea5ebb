//! Why nothing could be simulated.

use data::{DataError, KeyError};

/// Why a data set could not be made.
#[derive(Debug, thiserror::Error)]
pub enum SimulateError {
    /// A file could not be read or written, or says something that cannot be.
    #[error(transparent)]
    Data(#[from] DataError),
    /// The file system refused; the message names the path.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// A value cannot be.
    #[error(transparent)]
    Config(#[from] KeyError),
}
