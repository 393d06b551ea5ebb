//! Boxes in, numbers out: KITTI average precision and recall, and the statistics of two data sets.
//!
//! Everything is computed on the numbers of the texts, in the frame they are written in. KITTI's camera and LiDAR frames are
//! tilted against each other, so that a box upright in one is not upright in the other: a conversion would change overlaps.

mod curve;
mod evaluate;
mod matching;
mod options;
mod overlaps;
mod read;
mod recall;
mod report;
mod statistics;

pub use curve::{PrecisionCurve, ceiling_ap40};
pub use evaluate::evaluate;
pub use matching::Counts;
pub use options::{Difficulty, EvalFrame, EvalOptions, Metric, default_classes, reference_overlaps};
pub use read::{ids_of_folder, read_frames, read_ids};
pub use recall::{RECALL_OVERLAPS, Recall, RecallDefinition};
pub use report::{EvalReport, OverlapSet, Row, SCHEMA};
pub use statistics::{
    Extent, FrameCounts, STATISTICS_SCHEMA, SetStatistics, StatisticsReport, compare_statistics, sum_up,
};
