//! Poses, yaw, boxes, rotated overlap, NMS and points in boxes.
//!
//! Pure functions: no files, no clock, no global random numbers. Frame: x forward, y left, z up; yaw counter-clockwise from +x.

mod box3;
mod nms;
mod overlap;
mod points_in_boxes;
mod pose;

pub use box3::{Box3, limit_period};
pub use nms::rotated_nms;
pub use overlap::{bev_intersection, bev_iou, iou_3d};
pub use points_in_boxes::points_in_boxes;
pub use pose::{Pose, move_box, upright_pose, yaw_rad};
