//! From a cloud to a feature map seen from above (bird's-eye view): pillars, pillar feature net, scatter to a canvas,
//! 2D backbone. PointPillars and CenterPoint share all of it and differ in the head.

mod backbone;
mod config;
mod encoder;
mod input;
mod suppression;
mod vfe;

pub mod pillars;
pub mod scatter;

pub use backbone::{BackboneStages, BaseBevBackbone, Block};
pub use config::{BackboneConfig, PillarsConfig};
pub use encoder::{BevEncoder, BevStages, EncoderConfig, tensor_name};
pub use input::{PillarInput, PillarPreparation, PillarSample};
pub(crate) use suppression::far_below;
pub use suppression::suppress;
pub use vfe::{PillarRows, PillarVfe};
