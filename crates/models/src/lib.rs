//! PointPillars and PointRCNN in burn, faithful to the published networks to the last tensor.

pub mod checkpoint;
pub mod config;
pub mod kernel_ops;
pub mod layers;
pub mod loss;
pub mod named;
pub mod point_ops;
pub mod pointpillars;
pub mod pointrcnn;

mod built_in;
mod detector;
mod error;
mod inference;
mod layer_features;

pub use built_in::{detector_text, find_detector};
pub use detector::{Detector, Losses, Network, Prediction, Preparer, Sample, parameter_count};
pub use error::ModelError;
pub use inference::{inference_samples, predict_frames, predict_samples};
pub use layer_features::LayerFeatures;
pub use named::reference_name;
