//! Errors of a diagnosis.

use data::{DataError, ErrorKind, Located, Place};

/// A pair that cannot be diagnosed.
#[derive(Debug, thiserror::Error)]
pub enum DiagnoseError {
    /// A file could not be read or written, or has invalid content.
    #[error(transparent)]
    Data(#[from] DataError),
    /// The file system refused; the message names the path.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// The two sides do not match, or scans cannot be used.
    #[error("{0}")]
    Pair(String),
}

impl Located for DiagnoseError {
    fn place(&self) -> Place {
        match self {
            DiagnoseError::Data(error) => error.place(),
            DiagnoseError::Io(error) => error.place(),
            DiagnoseError::Pair(_) => Place::of_kind(ErrorKind::Invalid),
        }
    }
}
