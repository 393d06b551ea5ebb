//! LiDAR data sets by seeded ray casting: a race as triangle meshes with any sensors, and a small synthetic street.

pub mod auto_label;
mod error;
pub mod frame_scene;
mod json_forms;
pub mod mesh;
pub mod race;
pub mod race_car;
pub mod raycast;
pub mod resim;
pub mod scenario;
mod scenery;
pub mod shape_field;
pub mod street;
pub mod track;
pub mod world;

pub use error::SimulateError;
pub use json_forms::json_forms;
pub use scenery::Scenery;
pub use street::{FrameCounts, MANIFEST_SCHEMA, Manifest, RoadConfig, SplitCounts, make_road_dataset, make_road_frame};
