//! PointPillars (Lang et al. 2019), as OpenPCDet builds it.

mod architecture;
mod backbone;
mod config;
mod head;
mod loss;
mod network;
mod sample;
mod vfe;

pub mod anchors;
pub mod box_coder;
pub mod decode;
pub mod pillars;
pub mod scatter;
pub mod target_assigner;

pub use backbone::{BackboneStages, BaseBevBackbone, Block};
pub use config::*;
pub use head::{AnchorHead, Predictions};
pub use loss::losses;
pub use network::{PointPillars, Stages};
pub use sample::{Preparation, Sample};
pub use vfe::{PillarRows, PillarVfe};
