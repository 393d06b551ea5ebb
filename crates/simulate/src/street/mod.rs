//! A street with cars, walls, poles and distractors, seen by one spinning LiDAR: a small data set of single frames.
//!
//! All coordinates are in the LiDAR frame: origin at the sensor, x forward, y left, z up, m; yaw counter-clockwise
//! from +x, rad. A frame is a pure function of (configuration, split, index).
//!
//! Every car with at least five points is labelled, whatever its occlusion; the label has KITTI's occlusion level.

pub mod cars;
mod config;
mod dataset;
pub mod road;
mod roadside;
pub mod scene;
pub mod sensor;
pub mod solid;

pub use config::{FrameCounts, RoadConfig};
pub use dataset::{MANIFEST_SCHEMA, Manifest, SplitCounts, make_road_dataset, make_road_frame};
