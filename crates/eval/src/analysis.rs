//! What is behind the average precision of one run on one test set: the errors of its boxes, what its scores mean, and where the
//! ground truths are that it does not find.

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

/// Version of [`RunAnalysis`] as JSON.
pub const ANALYSIS_SCHEMA: &str = "lidarshift.run_analysis/1";

/// What is looked at.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct AnalysisOptions {
    /// Class, compared without regard to case.
    pub class: String,
    /// The frame of labels and detections.
    pub label_frame: LabelFrame,
    /// 3D overlap that a hit has to exceed, for everything but the errors.
    pub overlap: f64,
    /// Ground truth and detections whose centre is farther away on the ground are ignored, m.
    pub max_range_m: f64,
    /// Sections of distance for the errors.
    pub sections: Vec<RangeSection>,
    /// For the errors and the repairs, a detection and a ground truth are a pair when their centres are at most so far apart on the
    /// ground, m. A limit on the overlap would cut the errors off.
    pub pair_distance_m: f64,
    /// Detections with a lower score are left out of the errors.
    pub least_score: f64,
    /// Width of the steps of distance, m.
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

/// Everything about one run on one test set.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct RunAnalysis {
    /// [`ANALYSIS_SCHEMA`].
    pub schema: String,
    /// By which rules.
    pub options: AnalysisOptions,
    /// Errors of the boxes.
    pub errors: BoxErrors,
    /// What scores mean.
    pub calibration: Calibration,
    /// AP against the distance on the ground.
    pub by_distance: Vec<Stratum>,
    /// AP against the heading relative to the ray from the sensor, degrees.
    pub by_heading: Vec<Stratum>,
    /// AP against the number of points in the box; empty without clouds.
    pub by_points: Vec<Stratum>,
    /// AP against the overlap that is asked for.
    pub by_overlap: Vec<Stratum>,
    /// What AP becomes when a component of the boxes is set to the truth.
    pub oracle: Vec<Repair>,
}

/// Analyses one run. `points` are the numbers of points in the boxes of each frame, where clouds are at hand.
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
