//! LiDAR data sets by seeded ray casting: a race as triangle meshes with any sensors, and a small synthetic street.

mod config_text;
mod error;
pub mod raycast;
pub mod street;

pub use error::SimulateError;
pub use street::{FrameCounts, MANIFEST_SCHEMA, Manifest, RoadConfig, SplitCounts, make_road_dataset, make_road_frame};
