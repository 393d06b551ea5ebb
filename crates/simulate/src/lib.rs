//! LiDAR data sets by seeded ray casting: a race as triangle meshes with any sensors, and a small synthetic street.

pub mod attributes;
pub mod auto_label;
pub mod beams;
pub mod cloud_scan;
mod config_text;
pub mod effects;
mod error;
pub mod frame_scene;
pub mod matched;
pub mod mesh;
pub mod race;
pub mod race_car;
pub mod raycast;
pub mod resim;
pub mod rig;
pub mod scan;
pub mod scenario;
mod scenery;
pub mod street;
pub mod track;
pub mod world;

pub use error::SimulateError;
pub use rig::{Rig, Sensor};
pub use scenery::Scenery;
pub use street::{FrameCounts, MANIFEST_SCHEMA, Manifest, RoadConfig, SplitCounts, make_road_dataset, make_road_frame};
