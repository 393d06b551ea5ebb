//! The matrix: train set x test set x network, with means, deviations and intervals over the runs of each cell.
//!
//! Data flow: a [`TestSet`] reads the labels of a test set once; [`RunScores`] hold the scores of one run on one test
//! set; a [`MatrixPlan`] lists the planned cells; [`build`] aggregates the scores of all runs. A cell without a run
//! stays in the tables with the reason.
//!
//! The deviation over runs has divisor n. The paper (table in the appendix) does not state its divisor. Five of its
//! PointRCNN recalls, which are means of five numbers of the form k / 1000, are only possible with divisor n (for
//! example recall 99.46 (0.1)), and none only with n - 1.

mod build;
mod cell;
mod csv_lines;
mod latex;
mod markdown;
mod paired;
mod power;
mod published;
mod run_values;
mod scores;
mod split;

pub use build::{RunResult, build};
pub use cell::{Cell, CellNumber, CellRun, RunId, RunNumber, RunState};
pub use paired::{
    PairedDifference, PairedParts, PairedValues, ScoredFrames, Standing, paired_differences, paired_values, shared_ids,
};
pub use power::{Power, Scatter};
pub use published::{Published, published};
pub use run_values::{RunValue, from_run_values};
pub use scores::{RunScores, TestSet};
pub use split::{Part, Split};

use crate::bootstrap::Interval;
use crate::{BootstrapOptions, Difficulty, RangeSection};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::fmt;

/// Schema version of [`Matrix`] as JSON.
pub const MATRIX_SCHEMA: &str = "lidarshift.matrix/1";

/// A network or data set: one axis entry of the matrix.
#[derive(Clone, Debug, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Place {
    /// Name in folders and results.
    pub name: String,
    /// Title in tables.
    pub title: String,
    /// The paper's name for it, if it is the same; the paper's numbers are then shown next to ours.
    pub paper: Option<String>,
}

impl Place {
    /// An entry whose title is its name.
    pub fn new(name: &str) -> Self {
        Place { name: name.into(), title: name.into(), paper: None }
    }
}

/// The planned runs of one network.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct PlannedNetwork {
    /// The network, including its variant if the study has several.
    pub network: Place,
    /// Its train sets.
    pub train_sets: Vec<Place>,
    /// Seeds; one run per train set and seed.
    pub seeds: Vec<u64>,
}

/// The planned cells.
#[derive(Clone, Debug, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct MatrixPlan {
    /// In table order.
    pub networks: Vec<PlannedNetwork>,
    /// Test sets of every run, in table order.
    pub test_sets: Vec<Place>,
    /// Test sets that stand between two others.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub between: Vec<Between>,
}

/// A test set with the scenes of one data set and the sensor of another, which tells the sensor's share of a gap from
/// the scene's.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Between {
    /// [`Place::name`] of the test set.
    pub test_set: String,
    /// [`Place::name`] of the data set whose scenes it has.
    pub scene_of: String,
    /// [`Place::name`] of the data set whose sensor it has.
    pub sensor_of: String,
}

/// The boxes that detections were scored against.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, PartialOrd, Ord, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Reference {
    /// The labels of the test set.
    #[default]
    Labels,
    /// The labels with the corrections of a diagnosis.
    RepairedLabels,
    /// The true boxes, where the labels were made automatically and the truth is known.
    TrueBoxes,
}

impl Reference {
    /// From the labels to what comes closest to the truth.
    pub const ALL: [Reference; 3] = [Reference::Labels, Reference::RepairedLabels, Reference::TrueBoxes];

    /// What is written behind the title of a test set.
    pub fn suffix(self) -> &'static str {
        ["", ", repaired labels", ", true boxes"][self as usize]
    }

    /// Its name in files.
    pub fn key(self) -> &'static str {
        ["labels", "repaired_labels", "true_boxes"][self as usize]
    }
}

/// Evaluation settings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct MatrixOptions {
    /// Class names, compared case-insensitively.
    pub classes: Vec<String>,
    /// 3D IoU thresholds.
    pub overlaps: Vec<f64>,
    /// KITTI difficulty filter. For data without images, `all` is equal to the three KITTI levels.
    pub difficulty: Difficulty,
    /// Ground truth and detections whose centre is farther away on the ground plane are ignored, m.
    pub max_range_m: Option<f64>,
    /// Range sections reported in addition to the full range.
    pub sections: Vec<RangeSection>,
    /// Bootstrap settings.
    pub bootstrap: BootstrapOptions,
}

impl Default for MatrixOptions {
    /// The paper's settings: AP at 0.5 and 0.7, up to 100 m, in three range sections.
    fn default() -> Self {
        MatrixOptions {
            classes: vec!["Car".into()],
            overlaps: vec![0.5, 0.7],
            difficulty: Difficulty::All,
            max_range_m: Some(100.0),
            sections: RangeSection::PAPER.into(),
            bootstrap: BootstrapOptions::default(),
        }
    }
}

/// A metric of the matrix.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Quantity {
    /// KITTI 3D AP over 40 recall positions.
    Ap40,
    /// Area under the 3D precision-recall curve with a point at every score; not capped with few ground truths.
    ApArea,
    /// OpenPCDet's recall: ground truths whose highest IoU with any box exceeds the threshold. For two-stage networks,
    /// all refined RoIs are used, before the score threshold and the final NMS.
    RecallAnyBox,
    /// True positives of KITTI's matching divided by the number of ground truths.
    RecallMatched,
    /// As [`Quantity::RecallAnyBox`], but for the final boxes of any network.
    RecallFinalBoxes,
    /// KITTI AP over 40 recall positions by the overlap seen from above: heights do not matter.
    BevAp40,
}

impl Quantity {
    /// In the order of [`RunScores`].
    pub const ALL: [Quantity; 6] = [
        Quantity::Ap40,
        Quantity::ApArea,
        Quantity::RecallAnyBox,
        Quantity::RecallMatched,
        Quantity::RecallFinalBoxes,
        Quantity::BevAp40,
    ];

    /// Its key in files.
    pub fn key(self) -> &'static str {
        ["ap40", "ap_area", "recall_any_box", "recall_matched", "recall_final_boxes", "bev_ap40"][self as usize]
    }

    /// The metrics in the paper's table.
    pub const PAPER: [Quantity; 2] = [Quantity::Ap40, Quantity::RecallAnyBox];
}

impl fmt::Display for Quantity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Quantity::Ap40 => "3D AP",
            Quantity::ApArea => "3D AP, exact area",
            Quantity::RecallAnyBox => "Recall",
            Quantity::RecallMatched => "Recall, matched",
            Quantity::RecallFinalBoxes => "Recall, final boxes",
            Quantity::BevAp40 => "BEV AP",
        })
    }
}

/// Domain gap: the mean of the cell trained on the test set's own domain minus the mean of this cell, for one network
/// and test set. The paper's domain shift.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Gap {
    /// [`Place::name`] of the network.
    pub network: String,
    /// [`Place::name`] of the test set.
    pub test_set: String,
    /// [`Place::name`] of the train set whose value is subtracted.
    pub train_set: String,
    /// [`Place::name`] of the reference train set: that of the test set's domain, or a later one of the study.
    pub compared_to: String,
    /// What both were scored against.
    #[serde(default)]
    pub reference: Reference,
    /// Class name.
    pub class: String,
    /// Range section; `None`: full range.
    pub section: Option<RangeSection>,
    /// The metric.
    pub quantity: Quantity,
    /// 3D IoU threshold.
    pub overlap: f64,
    /// Difference of the means, percentage points.
    pub gap: f64,
    /// Bootstrap interval of the difference: both cells with the same resamples of frames and of seeds, since runs of
    /// one seed begin with the same weights and see their frames in the same order.
    pub interval: Option<Interval>,
}

/// The complete matrix.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Matrix {
    /// [`MATRIX_SCHEMA`].
    pub schema: String,
    /// The planned cells.
    pub plan: MatrixPlan,
    /// Settings used.
    pub options: MatrixOptions,
    /// By network, train set and test set, in plan order.
    pub cells: Vec<Cell>,
    /// By network, test set, train set.
    pub gaps: Vec<Gap>,
    /// Gaps of a network between its own data and another test set, split into label, sensor and scene.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub splits: Vec<Split>,
    /// What the study could see of each gap of 3D AP over the full range.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub power: Vec<Power>,
    /// Warnings to consider before using the numbers.
    pub warnings: Vec<String>,
}

impl Matrix {
    /// The cell of a network, train set and test set, by [`Place::name`].
    pub fn cell(&self, network: &str, train_set: &str, test_set: &str) -> Option<&Cell> {
        self.cells.iter().find(|c| c.network == network && c.train_set == train_set && c.test_set == test_set)
    }

    /// The title of a network or data set.
    pub fn title<'a>(&'a self, name: &'a str) -> &'a str {
        let networks = self.plan.networks.iter().flat_map(|n| std::iter::once(&n.network).chain(&n.train_sets));
        let mut places = networks.chain(&self.plan.test_sets);
        places.find(|place| place.name == name).map_or(name, |place| &place.title)
    }

    /// The title of a test set scored against a reference.
    pub fn test_title(&self, name: &str, reference: Reference) -> String {
        format!("{}{}", self.title(name), reference.suffix())
    }

    /// The matrix as JSON.
    ///
    /// # Panics
    /// Never: serialisation of plain data cannot fail.
    pub fn to_json(&self) -> String {
        let mut text = serde_json::to_string_pretty(self).expect("a matrix is plain data");
        text.push('\n');
        text
    }

    /// Table columns: those of the paper, the recall of the final boxes if a network has a separate any-box recall, and
    /// AP seen from above.
    pub fn columns(&self) -> Vec<(Quantity, f64)> {
        let mean = |cell: &Cell, class: &str, quantity, overlap| cell.number(class, None, quantity, overlap)?.mean;
        let differs = |cell: &Cell, class: &str, overlap: f64| {
            let of_final = mean(cell, class, Quantity::RecallFinalBoxes, overlap);
            of_final.is_some() && of_final != mean(cell, class, Quantity::RecallAnyBox, overlap)
        };
        let (classes, overlaps) = (&self.options.classes, &self.options.overlaps);
        let two_stage =
            self.cells.iter().any(|cell| classes.iter().any(|class| overlaps.iter().any(|o| differs(cell, class, *o))));
        let of_final = overlaps.iter().filter(|_| two_stage).map(|overlap| (Quantity::RecallFinalBoxes, *overlap));
        let bev = overlaps.iter().map(|overlap| (Quantity::BevAp40, *overlap));
        self.paper_columns().into_iter().chain(of_final).chain(bev).collect()
    }

    /// Columns of the paper's table: AP at each overlap, then recall at each.
    fn paper_columns(&self) -> Vec<(Quantity, f64)> {
        Quantity::PAPER.iter().flat_map(|q| self.options.overlaps.iter().map(|overlap| (*q, *overlap))).collect()
    }
}

/// Formats a number as in the paper: one or two decimals.
pub(crate) fn paper_number(value: f64) -> String {
    let text = format!("{value:.2}");
    text.strip_suffix('0').map_or(text.clone(), String::from)
}

/// `mean (deviation)` as in the paper's table; a dash if missing.
pub(crate) fn paper_cell(mean: Option<f64>, deviation: Option<f64>) -> String {
    match (mean, deviation) {
        (Some(mean), Some(deviation)) => format!("{} ({})", paper_number(mean), paper_number(deviation)),
        (Some(mean), None) => paper_number(mean),
        (None, _) => "-".into(),
    }
}
