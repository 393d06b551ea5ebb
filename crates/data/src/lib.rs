//! Frames and where they come from.
//!
//! Everything here is in the LiDAR frame: x forward, y left, z up; yaw counter-clockwise from +x; the centre of a box is its geometric centre.

mod error;
mod frame;
mod stream;

pub use error::DataError;
pub use frame::{Cloud, Detection, Frame, Object};
pub use stream::{Stream, stream};
