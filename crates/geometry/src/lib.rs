//! Poses, yaw, boxes, rotated overlap, NMS and points in boxes.
//!
//! Pure functions: no files, no clock, no global random numbers. Frame: x forward, y left, z up; yaw counter-clockwise from +x.

mod box3;

pub use box3::{Box3, limit_period};
