//! The native half of the Python package `lidarshift`. The other half, in `python/lidarshift`, has the documentation
//! and converts arguments.

mod arrays;
mod average_precision;
mod dataset;
mod effects;
mod errors;

use pyo3::prelude::*;
use std::ffi::OsString;
use std::path::PathBuf;

/// Runs the program with these arguments, its name included; returns the exit code. `program` is what a study starts
/// for its runs.
#[pyfunction]
fn run(py: Python<'_>, arguments: Vec<OsString>, program: Option<PathBuf>) -> PyResult<u8> {
    // The executable of the process is the interpreter.
    data::set_program_file(py.import("lidarshift._native")?.filename()?.extract()?);
    if let Some(program) = program {
        study::set_program(program);
    }
    Ok(py.detach(|| lidarshift::run_with(arguments)))
}

#[pymodule]
fn _native(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add("LidarshiftError", module.py().get_type::<errors::LidarshiftError>())?;
    module.add_class::<dataset::Dataset>()?;
    module.add_class::<effects::Effects>()?;
    module.add_function(wrap_pyfunction!(dataset::read_cloud, module)?)?;
    module.add_function(wrap_pyfunction!(average_precision::kitti_ap, module)?)?;
    module.add_function(wrap_pyfunction!(average_precision::kitti_ap_of_folders, module)?)?;
    module.add_function(wrap_pyfunction!(run, module)?)
}
