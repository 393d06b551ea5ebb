//! Evaluation of boxes, clouds and features: KITTI average precision and recall, the matrix of train and test sets,
//! and statistics of two data sets.
//!
//! Boxes are compared in the frame in which they are written. KITTI's camera and LiDAR frames are tilted against each
//! other, so a box that is upright in one frame is not upright in the other, and a conversion would change overlaps.

pub mod analysis;
mod bootstrap;
mod box_transform;
pub mod comparison;
mod csv_text;
mod curve;
mod dataset_statistics;
pub mod distance;
mod evaluate;
mod evidence;
pub mod features;
mod json_forms;
mod matching;
pub mod matrix;
mod options;
mod overlaps;
mod read;
mod recall;
mod report;
pub mod targets;

pub use bootstrap::{BootstrapOptions, Interval};
pub use box_transform::{BoxTransform, TRANSFORM_OVERLAP, TransformFit};
pub use csv_text::csv_text;
pub use curve::{PrecisionCurve, ceiling_ap40};
pub use dataset_statistics::{
    Extent, FrameCounts, STATISTICS_SCHEMA, SetStatistics, StatisticsReport, compare_statistics, sum_up,
};
pub use evaluate::evaluate;
pub use json_forms::json_forms;
pub use matching::Counts;
pub use options::{Difficulty, EvalFrame, EvalOptions, Metric, RangeSection, default_classes, reference_overlaps};
pub use read::{detections_of, ids_of_folder, read_detections, read_frames, read_ids};
pub use recall::{RECALL_OVERLAPS, Recall, RecallDefinition};
pub use report::{EvalReport, OverlapSet, Row, SCHEMA};
