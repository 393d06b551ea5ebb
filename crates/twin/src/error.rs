//! Errors of twins.

use data::{DataError, ErrorKind, KeyError, Located, Place};

/// Why no twin can be made.
#[derive(Debug, thiserror::Error)]
pub enum TwinError {
    /// A file of the recording, or one that is written.
    #[error(transparent)]
    Data(#[from] DataError),
    /// What is written as TOML or JSON.
    #[error(transparent)]
    Key(#[from] KeyError),
    /// The recording lacks something.
    #[error("{0}")]
    Recording(String),
}

impl Located for TwinError {
    fn place(&self) -> Place {
        match self {
            TwinError::Data(error) => error.place(),
            TwinError::Key(error) => error.place(),
            TwinError::Recording(_) => Place::of_kind(ErrorKind::Invalid),
        }
    }
}
