//! Analysis of one run on one test set beyond average precision: box errors, score calibration, and AP by distance,
//! heading, number of points and overlap.

mod calibration;
mod errors;
mod oracle;
mod pairs;
mod strata;

pub use calibration::{Calibration, ScoreBin, calibration};
pub use errors::{BoxErrors, ComponentError, ErrorSection, box_errors};
pub use oracle::{Component, Repair, oracle};
pub use strata::{BoxPoints, Stratum, by_distance, by_heading, by_overlap, by_points};

use crate::{EvalFrame, RangeSection};
use data::LabelFrame;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Schema version of [`RunAnalysis`] as JSON.
pub const ANALYSIS_SCHEMA: &str = "lidarshift.run_analysis/1";

/// Settings of the analysis.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct AnalysisOptions {
    /// Class name, compared case-insensitively.
    pub class: String,
    /// Coordinate frame of labels and detections.
    pub label_frame: LabelFrame,
    /// 3D IoU that a true positive has to exceed. Not used for the box errors.
    pub overlap: f64,
    /// Ground truth and detections whose centre is farther away on the ground plane are ignored, m.
    pub max_range_m: f64,
    /// Range sections for which box errors are reported.
    pub sections: Vec<RangeSection>,
    /// Box errors and oracle repairs: a detection and a ground truth form a pair if their centres are at most this far
    /// apart on the ground plane, m. An IoU limit would truncate the error distribution.
    pub pair_distance_m: f64,
    /// Detections with a lower score are excluded from the box errors.
    pub least_score: f64,
    /// Bin width for AP by distance, m.
    pub step_m: f64,
}

impl Default for AnalysisOptions {
    fn default() -> Self {
        AnalysisOptions {
            class: "Car".into(),
            label_frame: LabelFrame::Lidar,
            overlap: 0.7,
            max_range_m: 100.0,
            sections: RangeSection::PAPER.into(),
            pair_distance_m: 2.0,
            least_score: 0.1,
            step_m: 10.0,
        }
    }
}

/// Analysis of one run on one test set.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct RunAnalysis {
    /// [`ANALYSIS_SCHEMA`].
    pub schema: String,
    /// Settings used.
    pub options: AnalysisOptions,
    /// Errors of the predicted boxes.
    pub errors: BoxErrors,
    /// Score calibration.
    pub calibration: Calibration,
    /// AP by ground-plane distance.
    pub by_distance: Vec<Stratum>,
    /// AP by heading relative to the ray from the sensor, degrees.
    pub by_heading: Vec<Stratum>,
    /// AP by number of points in the box; empty if no clouds were given.
    pub by_points: Vec<Stratum>,
    /// AP by IoU threshold.
    pub by_overlap: Vec<Stratum>,
    /// AP after replacing one component of the predicted boxes with the ground truth.
    pub oracle: Vec<Repair>,
}

/// Analyses one run. `points` holds the number of points in each box of each frame, if clouds are available.
pub fn analyse(frames: &[EvalFrame], points: Option<&[BoxPoints]>, options: &AnalysisOptions) -> RunAnalysis {
    RunAnalysis {
        schema: ANALYSIS_SCHEMA.into(),
        options: options.clone(),
        errors: box_errors(frames, options),
        calibration: calibration(frames, options),
        by_distance: by_distance(frames, options),
        by_heading: by_heading(frames, options),
        by_points: points.map_or(Vec::new(), |points| by_points(frames, points, options)),
        by_overlap: by_overlap(frames, options),
        oracle: oracle(frames, options),
    }
}
