//! Errors of the crates as Python exceptions with file, line and hint.

use data::DataError;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use std::path::PathBuf;

pyo3::create_exception!(lidarshift, LidarshiftError, PyValueError);

/// The exception of an error.
pub fn raised(py: Python<'_>, error: DataError) -> PyErr {
    let text = error.to_string();
    match error {
        DataError::Io(_) => with_place(py, &text, None, None),
        DataError::Line { path, line, .. } => with_place(py, &text, Some(path), Some(line)),
        DataError::File { path, .. } => with_place(py, &text, Some(path), None),
    }
}

/// An exception. What to do stands behind the last semicolon of a message.
pub fn with_place(py: Python<'_>, text: &str, file: Option<PathBuf>, line: Option<usize>) -> PyErr {
    let error = LidarshiftError::new_err(text.to_owned());
    let hint = text.rsplit_once("; ").map(|(_, hint)| hint.to_owned());
    let value = error.value(py);
    let set = value.setattr("file", file.map(|path| path.display().to_string()));
    let set = set.and_then(|()| value.setattr("line", line)).and_then(|()| value.setattr("hint", hint));
    set.err().unwrap_or(error)
}
