//! PointPillars in burn, faithful to the published network to the last tensor.

pub mod checkpoint;
pub mod config;
pub mod kernel_ops;
pub mod layers;
pub mod loss;
pub mod named;
pub mod pointpillars;

mod detector;
mod error;

pub use detector::{Detector, Losses, Preparer, Sample, parameter_count};
pub use error::ModelError;
pub use named::reference_name;
