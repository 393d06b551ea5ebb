//! Data sets: frames (point clouds with labelled boxes), their file formats, augmentation and checks.
//!
//! Coordinates are in the LiDAR frame unless stated otherwise: x forward, y left, z up, m; yaw counter-clockwise from
//! +x, rad. The centre of a box is its geometric centre.

pub mod augment;
mod build;
mod calibration;
pub mod checksum;
mod cloud_file;
mod content;
pub mod convert;
mod dataset;
mod dataset_config;
mod detections_file;
pub mod doctor;
mod error;
mod file_part;
mod folder_lock;
mod frame;
mod frame_index;
mod frame_records;
mod ground_height;
mod gt_database;
mod json_form;
mod kitti_text;
mod label_box;
pub mod layout;
pub mod limits;
mod lzf;
mod new_dataset;
pub mod output;
mod output_guard;
mod pcd;
mod pcd_columns;
mod pcd_header;
mod place;
mod prefetch;
mod presence;
mod source;
#[cfg(feature = "store")]
mod store;
mod stream;
pub mod toml_text;
pub mod write;

pub use augment::{AugmentConfig, augment};
pub use build::{build_id, features, program_sha256, set_commit, set_features, set_program_file};
pub use calibration::Calibration;
pub use cloud_file::{FARTHEST_M, PointColumns, parse_bin, read_cloud};
pub use dataset::{Dataset, parse_split};
pub use dataset_config::DatasetConfig;
pub use detections_file::{
    DETECTIONS_FILE, DetectionsWriter, FoundDetections, detections_file, frames_of_detections, read_detections_file,
    write_detections,
};
pub use error::DataError;
pub use file_part::FilePart;
pub use folder_lock::{FolderLock, is_unused};
pub use frame::{Cloud, Detection, Frame, Object};
pub use frame_records::{FRAMES_FILE, verify_frames};
pub use ground_height::{GroundConfig, GroundHeight};
pub use gt_database::{GtDatabase, GtSample};
pub use json_form::{JsonForm, json_forms};
pub use kitti_text::{KittiLine, KittiText, parse_kitti_text, read_kitti_text, to_kitti_text};
pub use label_box::{DONT_CARE, LabelBox, LabelFrame};
pub use layout::{DataLayout, Layout, Moment, PointDetails, Sequence, TrackedObject};
pub use new_dataset::{Manifest, NewDataset};
pub use output::write_atomic;
pub use output_guard::refuse_input_file;
pub use pcd::{encode_pcd, parse_pcd};
pub use pcd_columns::{PcdColumn, encode_pcd_columns, parse_pcd_columns, write_pcd_columns};
pub use pcd_header::{PcdEncoding, PcdHeader, parse_pcd_header};
pub use place::{ErrorKind, Located, Place, hint};
pub use prefetch::{Prefetch, prefetch, prefetch_numbered};
pub use presence::Presence;
pub use source::{absolute, is_url};
pub use stream::{Stream, stream};
pub use toml_text::KeyError;
pub use write::write_json;
