//! LiDAR data sets by seeded ray casting: a race as triangle meshes with any sensors, and a small synthetic street.

mod config_text;
mod error;
pub mod mesh;
pub mod race_car;
pub mod raycast;
pub mod rig;
pub mod scenario;
pub mod street;
pub mod track;

pub use error::SimulateError;
pub use rig::{Rig, Sensor};
pub use street::{FrameCounts, MANIFEST_SCHEMA, Manifest, RoadConfig, SplitCounts, make_road_dataset, make_road_frame};
