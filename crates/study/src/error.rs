//! Why a study cannot go on.

use data::DataError;
use eval::distance::DistanceError;
use eval::features::FeatureError;
use models::ModelError;
use report::ReportError;
use simulate::SimulateError;
use train::TrainError;

/// A study that cannot be read, made or shown.
#[derive(Debug, thiserror::Error)]
pub enum StudyError {
    /// A file of a data set, or any file that cannot be read or written.
    #[error(transparent)]
    Data(#[from] DataError),
    /// A simulation that cannot be made.
    #[error(transparent)]
    Simulate(#[from] SimulateError),
    /// A network, its weights or a frame that it cannot take.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// A run that cannot begin, go on or end.
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
    /// The file system or a process refused.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// A result that is no JSON of its kind.
    #[error(transparent)]
    Json(#[from] serde_json::Error),
    /// A detector's file that is no TOML.
    #[error(transparent)]
    Toml(#[from] toml::de::Error),
    /// What was asked for cannot be.
    #[error("{0}")]
    Refused(String),
    /// An error of a part of the study.
    #[error("{part}: {error}")]
    Part {
        /// Which part.
        part: String,
        /// What went wrong in it.
        error: Box<StudyError>,
    },
}

/// What a function of this crate gives.
pub type Result<T, E = StudyError> = std::result::Result<T, E>;

/// The error of what cannot be.
pub(crate) fn refused(text: impl Into<String>) -> StudyError {
    StudyError::Refused(text.into())
}

/// Names the part in which an error occurred.
pub(crate) trait InPart<T> {
    /// The same result; an error says the part.
    fn in_part(self, part: impl FnOnce() -> String) -> Result<T>;
}

impl<T, E: Into<StudyError>> InPart<T> for Result<T, E> {
    fn in_part(self, part: impl FnOnce() -> String) -> Result<T> {
        self.map_err(|error| StudyError::Part { part: part(), error: Box::new(error.into()) })
    }
}
