//! Errors of a study.

use data::{DataError, ErrorKind, Located, Place};
use eval::distance::DistanceError;
use eval::features::FeatureError;
use models::ModelError;
use report::ReportError;
use simulate::SimulateError;
use train::TrainError;

/// An error while reading, running or reporting a study.
#[derive(Debug, thiserror::Error)]
pub enum StudyError {
    /// A data set, or a file that cannot be read or written.
    #[error(transparent)]
    Data(#[from] DataError),
    /// A simulation that fails.
    #[error(transparent)]
    Simulate(#[from] SimulateError),
    /// A network, its weights, or a frame that it cannot process.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// A training run that fails.
    #[error(transparent)]
    Train(#[from] TrainError),
    /// Clouds that cannot be compared.
    #[error(transparent)]
    Distance(#[from] DistanceError),
    /// Features that cannot be compared.
    #[error(transparent)]
    Feature(#[from] FeatureError),
    /// A report that cannot be written.
    #[error(transparent)]
    Report(#[from] ReportError),
    /// An error of the file system or of a process.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// A result file with invalid JSON.
    #[error(transparent)]
    Json(#[from] serde_json::Error),
    /// A run or its folder that another process uses.
    #[error("{0} is in use by another process; wait until it ends")]
    InUse(String),
    /// A request that cannot be fulfilled; the text gives the reason.
    #[error("{0}")]
    Refused(String),
    /// An error in a part of the study.
    #[error("{part}: {error}")]
    Part {
        /// Name of the part.
        part: String,
        /// The error.
        error: Box<StudyError>,
    },
}

impl Located for StudyError {
    fn place(&self) -> Place {
        match self {
            StudyError::Data(error) => error.place(),
            StudyError::Simulate(error) => error.place(),
            StudyError::Model(error) => error.place(),
            StudyError::Train(error) => error.place(),
            StudyError::Distance(error) => error.place(),
            StudyError::Report(error) => error.place(),
            StudyError::Io(error) => error.place(),
            StudyError::Part { error, .. } => error.place(),
            StudyError::Feature(_) | StudyError::Json(_) => Place::of_kind(ErrorKind::Invalid),
            StudyError::InUse(_) => Place::of_kind(ErrorKind::InUse),
            StudyError::Refused(_) => Place::of_kind(ErrorKind::Refused),
        }
    }
}

impl StudyError {
    /// Whether a training was stopped by [`train::Session::stop`], which is no failure.
    pub fn is_stopped(&self) -> bool {
        match self {
            StudyError::Train(TrainError::Stopped { .. }) => true,
            StudyError::Part { error, .. } => error.is_stopped(),
            _ => false,
        }
    }
}

/// Result with an error of this crate.
pub type Result<T, E = StudyError> = std::result::Result<T, E>;

/// A [`StudyError::Refused`] with this text.
pub(crate) fn refused(text: impl Into<String>) -> StudyError {
    StudyError::Refused(text.into())
}

/// Adds the name of a part to an error.
pub(crate) trait InPart<T> {
    /// The same result; an error contains the name of the part.
    fn in_part(self, part: impl FnOnce() -> String) -> Result<T>;
}

impl<T, E: Into<StudyError>> InPart<T> for Result<T, E> {
    fn in_part(self, part: impl FnOnce() -> String) -> Result<T> {
        self.map_err(|error| StudyError::Part { part: part(), error: Box::new(error.into()) })
    }
}
