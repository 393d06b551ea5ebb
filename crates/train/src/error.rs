//! Why a run cannot begin, go on or end.

use data::DataError;
use models::ModelError;
use std::panic::{AssertUnwindSafe, catch_unwind};
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
    /// A panic within a step; burn reports so that a device is lost, or out of memory.
    #[error(
        "step {step}: computing broke off: {message}. The run's last checkpoint is good: the same words go on from there, also with another \
         --device; where memory ran out, lower optimization.batch_size"
    )]
    BrokeOff {
        /// Counted from 0.
        step: u64,
        /// What the panic said.
        message: String,
    },
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

/// The result of a step's work, a panic in it as an error.
pub(crate) fn without_panic<T>(step: u64, work: impl FnOnce() -> Result<T, TrainError>) -> Result<T, TrainError> {
    catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|panic| {
        let text = panic.downcast_ref::<String>().map(String::as_str).or_else(|| panic.downcast_ref::<&str>().copied());
        Err(TrainError::BrokeOff { step, message: text.unwrap_or("for no stated reason").into() })
    })
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lost_device_ends_a_run_with_a_message() {
        let lost = without_panic::<()>(7, || panic!("device {} was lost", 0)).unwrap_err().to_string();
        assert!(
            lost.starts_with("step 7: computing broke off: device 0 was lost. The run's last checkpoint"),
            "{lost}"
        );
        assert!(without_panic(7, || Ok(3)).is_ok_and(|value| value == 3));
    }
}
