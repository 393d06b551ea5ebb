//! Errors of the crates as Python exceptions with file, line, hint, code and kind.

use data::{DataError, ErrorKind, Located as _, Place};
use lidarshift::errors::ErrorReport;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use std::path::PathBuf;

pyo3::create_exception!(lidarshift, LidarshiftError, PyValueError);

/// Exit code of the program for the same error.
const CODE: u8 = 1;

/// The exception of an error.
#[expect(clippy::needless_pass_by_value, reason = "the form that `map_err` takes")]
pub fn raised(py: Python<'_>, error: DataError) -> PyErr {
    exception(py, ErrorReport::new(CODE, error.place(), error.to_string()))
}

/// An exception about an argument, or about a file.
pub fn with_place(py: Python<'_>, text: &str, file: Option<PathBuf>) -> PyErr {
    let kind = if file.is_some() { ErrorKind::Invalid } else { ErrorKind::Refused };
    exception(py, ErrorReport::new(CODE, Place { kind, file, line: None }, text.to_owned()))
}

fn exception(py: Python<'_>, report: ErrorReport) -> PyErr {
    let error = LidarshiftError::new_err(report.message);
    let value = error.value(py);
    let kind = serde_json::to_value(report.kind).expect("a kind is plain data");
    let set = || {
        value.setattr("file", report.file)?;
        value.setattr("line", report.line)?;
        value.setattr("hint", report.hint)?;
        value.setattr("code", report.code)?;
        value.setattr("kind", kind.as_str())
    };
    set().err().unwrap_or(error)
}
