//! Frames and where they come from.
//!
//! Everything here is in the LiDAR frame: x forward, y left, z up; yaw counter-clockwise from +x; the centre of a box is its geometric centre.

mod error;
mod frame;
pub mod kitti_text;
mod stream;

pub use error::DataError;
pub use frame::{Cloud, Detection, Frame, Object};
pub use kitti_text::{DONT_CARE, KittiLine, KittiText, LabelFrame, parse_kitti_text, read_kitti_text, to_kitti_text};
pub use stream::{Stream, stream};
