//! Why nothing could be diagnosed.

use data::DataError;

/// A pair that cannot be looked at as it is.
#[derive(Debug, thiserror::Error)]
pub enum DiagnoseError {
    /// A file could not be read or written, or says something that cannot be.
    #[error(transparent)]
    Data(#[from] DataError),
    /// The file system refused; the message names the path.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// The two sides do not fit each other.
    #[error("{0}")]
    Pair(String),
}
