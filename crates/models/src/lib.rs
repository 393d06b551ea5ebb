//! Detectors in burn. The published networks equal OpenPCDet's tensor by tensor. The list `detectors!` at the end
//! of this file has all of them; each implements [`Architecture`].

#[macro_use]
mod detectors;

pub mod bev;
pub mod checkpoint;
pub mod config;
#[cfg_attr(not(feature = "cube"), path = "gpu_kernels/absent.rs")]
pub mod gpu_kernels;
pub mod kernel_ops;
pub mod layers;
pub mod limits;
pub mod loss;
pub mod named;
pub mod onnx;
pub mod point_ops;
pub mod products;
pub mod results;
pub mod row_ops;
pub mod suggest;

mod architecture;
mod built_in;
mod detector;
mod error;
mod inference;
mod layer_features;
#[cfg(test)]
mod tests;

pub use architecture::{Architecture, NetworkInput};
pub use built_in::{detector_text, find_detector};
pub use detector::{Detector, Losses, Prediction, Preparer, Sample, parameter_count};
pub use error::ModelError;
pub use inference::{inference_samples, predict_frames, predict_samples};
pub use layer_features::LayerFeatures;
pub use named::reference_name;

detectors! {
    /// PointPillars (Lang et al. 2019) as OpenPCDet builds it.
    PointPillars(pointpillars::PointPillars),
    /// PointRCNN (Shi et al. 2019) as OpenPCDet builds it.
    PointRcnn(pointrcnn::PointRcnn),
    /// CenterPoint with pillars (Yin et al. 2021) as OpenPCDet builds it, one stage.
    CenterPoint(centerpoint::CenterPoint),
}
