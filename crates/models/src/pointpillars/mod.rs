//! PointPillars (Lang et al. 2019), as OpenPCDet builds it.

mod architecture;
mod config;
mod head;
mod loss;
mod network;
mod sample;

pub mod anchors;
pub mod box_coder;
pub mod decode;
pub mod target_assigner;

pub use config::*;
pub use head::{AnchorHead, Predictions};
pub use loss::losses;
pub use network::{PointPillars, Stages};
pub use sample::{Preparation, Sample};
