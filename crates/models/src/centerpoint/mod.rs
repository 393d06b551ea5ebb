//! CenterPoint with pillars (Yin et al. 2021), as OpenPCDet builds it: the network without anchors, one stage.

mod architecture;
mod config;
mod head;
mod loss;
mod network;
mod sample;

pub mod box_coder;
pub mod decode;
pub mod heat_map;
pub mod target_assigner;

pub use config::*;
pub use head::{CenterHead, HeadOutputs, SeparateHead};
pub use loss::losses;
pub use network::{CenterPoint, Stages};
pub use sample::{Preparation, Sample};
