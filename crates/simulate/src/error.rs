//! Why nothing could be simulated.

use data::DataError;

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
    #[error("{field}: {message}")]
    Config {
        /// The key, as `sensor[0].rows`.
        field: String,
        /// What is wrong and what would be right.
        message: String,
    },
}

impl SimulateError {
    /// The same error with `prefix.` before the key.
    pub(crate) fn below(self, prefix: &str) -> Self {
        match self {
            SimulateError::Config { field, message } => {
                let field = if field.is_empty() { prefix.into() } else { format!("{prefix}.{field}") };
                SimulateError::Config { field, message }
            }
            other => other,
        }
    }
}

/// The error of one key.
pub(crate) fn wrong(field: impl Into<String>, message: impl Into<String>) -> SimulateError {
    SimulateError::Config { field: field.into(), message: message.into() }
}

/// Refuses a number outside of `low..=high`; not-a-number as well.
pub(crate) fn within(field: &str, value: f64, low: f64, high: f64) -> Result<(), SimulateError> {
    if (low..=high).contains(&value) {
        Ok(())
    } else {
        Err(wrong(field, format!("{value} is not between {low} and {high}")))
    }
}
