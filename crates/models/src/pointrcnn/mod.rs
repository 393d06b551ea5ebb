//! PointRCNN (Shi et al. 2019), as OpenPCDet builds it.

mod architecture;
mod backbone;
mod config;
mod detect;
mod network;
mod point_head;
mod roi_head;
mod sample;
mod set_abstraction;
mod size_limits;
mod training;

pub mod box_coder;
pub mod hierarchy;
pub mod loss;
pub mod point_targets;
pub mod proposals;
pub mod roi_input;
pub mod roi_targets;

pub use backbone::{BackboneStages, FeaturePropagation, PointNet2Msg, SetAbstraction};
pub use config::*;
pub use detect::{detections, final_boxes, suppress};
pub use network::{PointRcnn, PointStages};
pub use point_head::{HiddenLayers, POINT_CODE, PointHead, PointPredictions};
pub use roi_head::{RoiHead, RoiStages};
pub use sample::{Preparation, Sample, SampleTargets};
pub use set_abstraction::SharedMlp;
pub use training::{losses, point_scores};
