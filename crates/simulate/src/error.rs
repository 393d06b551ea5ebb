//! Errors of the simulator.

use data::{DataError, KeyError, Located, Place};

/// Error that prevents a data set from being generated.
#[derive(Debug, thiserror::Error)]
pub enum SimulateError {
    /// A file could not be read or written, or its content is invalid.
    #[error(transparent)]
    Data(#[from] DataError),
    /// Input or output error; the message names the path.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// A value is invalid; the message names the key.
    #[error(transparent)]
    Config(#[from] KeyError),
}

impl Located for SimulateError {
    fn place(&self) -> Place {
        match self {
            SimulateError::Data(error) => error.place(),
            SimulateError::Io(error) => error.place(),
            SimulateError::Config(error) => error.place(),
        }
    }
}
