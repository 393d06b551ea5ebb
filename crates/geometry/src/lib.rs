//! Poses, yaw, boxes, rotated overlap, NMS, points in boxes, sampling and neighbours of points.
//!
//! Pure functions: no files, no clock, no global random numbers. Frame: x forward, y left, z up; yaw counter-clockwise
//! from +x.

mod ball_query;
mod box3;
mod farthest_point;
mod nms;
mod overlap;
mod point_grid;
mod points_in_boxes;
mod pose;
mod roi_points;
mod three_nn;

pub use ball_query::ball_query;
pub use box3::{Box3, limit_period};
pub use farthest_point::{TieRule, farthest_point_sampling};
pub use nms::{rotated_nms, rotated_nms_first};
pub use overlap::{bev_intersection, bev_iou, iou_3d};
pub use points_in_boxes::points_in_boxes;
pub use pose::{Pose, move_box, upright_pose, yaw_rad};
pub use roi_points::{RoiPoints, roi_points};
pub use three_nn::{ThreeNearest, three_nearest};
