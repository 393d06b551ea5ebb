//! Errors of a training run.

use data::{DataError, ErrorKind, Located, Place};
use models::ModelError;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

/// An error of a training run.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// A file of the data set, or any file that cannot be read or written.
    #[error(transparent)]
    Data(#[from] DataError),
    /// The network, its weights or a frame that it cannot read.
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
    /// A configuration that is invalid.
    #[error("{0}")]
    Config(String),
    /// A panic within a step. burn panics if a device is lost or out of memory.
    #[error(
        "step {step}: the computation failed: {message}. The run's last checkpoint is intact: the same command with --resume continues from it, \
         also on another --device; if memory ran out, lower optimization.batch_size"
    )]
    Panicked {
        /// Counted from 0.
        step: u64,
        /// The message of the panic.
        message: String,
    },
    /// The training was stopped by [`crate::Session::stop`]; its checkpoint is saved.
    #[error("stopped after step {step} of {total_steps}; a checkpoint is saved, and --resume continues from it")]
    Stopped {
        /// Steps done.
        step: u64,
        /// Steps of the whole run.
        total_steps: u64,
    },
    /// The training has diverged, or its data are damaged.
    #[error(
        "step {step}: {what} is not finite; the batch holds the frames {}. The run stops; its last checkpoint is intact. \
         Look at these frames with `lidarshift doctor`, or lower optimization.lr_max",
        frames.join(", ")
    )]
    NotFinite {
        /// Counted from 0.
        step: u64,
        /// The loss or the parameter's gradient that is not finite.
        what: String,
        /// The frames of the batch.
        frames: Vec<String>,
    },
}

/// Runs the work of a step and converts a panic into an error.
pub(crate) fn without_panic<T>(step: u64, work: impl FnOnce() -> Result<T, TrainError>) -> Result<T, TrainError> {
    catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|panic| {
        let text = panic.downcast_ref::<String>().map(String::as_str).or_else(|| panic.downcast_ref::<&str>().copied());
        Err(TrainError::Panicked { step, message: text.unwrap_or("for no stated reason").into() })
    })
}

impl From<std::io::Error> for TrainError {
    fn from(error: std::io::Error) -> Self {
        TrainError::Data(error.into())
    }
}

impl Located for TrainError {
    fn place(&self) -> Place {
        match self {
            TrainError::Data(error) => error.place(),
            TrainError::Model(error) => error.place(),
            TrainError::Folder { path, .. } => Place::in_file(ErrorKind::Invalid, path),
            TrainError::Config(_) => Place::of_kind(ErrorKind::Invalid),
            TrainError::Panicked { .. } => Place::of_kind(ErrorKind::Computation),
            TrainError::Stopped { .. } => Place::of_kind(ErrorKind::Stopped),
            TrainError::NotFinite { .. } => Place::of_kind(ErrorKind::NotFinite),
        }
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
    fn a_lost_device_ends_a_run_with_an_error() {
        let lost = without_panic::<()>(7, || panic!("device {} was lost", 0)).unwrap_err().to_string();
        assert!(
            lost.starts_with("step 7: the computation failed: device 0 was lost. The run's last checkpoint"),
            "{lost}"
        );
        assert!(without_panic(7, || Ok(3)).is_ok_and(|value| value == 3));
    }
}
