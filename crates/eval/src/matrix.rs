//! The matrix: train set x test set x network, with means, deviations and intervals over the runs of each cell.
//!
//! The road: a [`TestSet`] reads the labels of a test set once; [`RunScores`] are what one run does on one test set; a
//! [`MatrixPlan`] says which cells there should be; [`build`] puts the scores of all runs into them. A cell without a run stays in
//! the tables and says why.
//!
//! The deviation is the one of the runs themselves, with divisor n. The paper (table in the appendix) does not say which it
//! prints; five of its PointRCNN recalls, which are means of five numbers of the form k / 1000, can only come from divisor n
//! (recall 99.46 (0.1), for one), and none only from n - 1.

mod build;
mod csv_lines;
mod latex;
mod markdown;
mod published;
mod run_values;
mod scores;

pub use build::{RunResult, build};
pub use published::{Published, published};
pub use run_values::{RunValue, from_run_values};
pub use scores::{RunScores, TestSet};

use crate::bootstrap::Interval;
use crate::{BootstrapOptions, Difficulty, RangeSection};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::fmt;

/// Version of [`Matrix`] as JSON.
pub const MATRIX_SCHEMA: &str = "lidarshift.matrix/1";

/// A network or a data set as a place in the matrix.
#[derive(Clone, Debug, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Place {
    /// As folders and results call it.
    pub name: String,
    /// As tables call it.
    pub title: String,
    /// What the paper calls the same thing, where it is the same: its numbers then stand beside ours.
    pub paper: Option<String>,
}

impl Place {
    /// A place whose title is its name.
    pub fn new(name: &str) -> Self {
        Place { name: name.into(), title: name.into(), paper: None }
    }
}

/// The runs that should exist of one network.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct PlannedNetwork {
    /// The network, with its variant where a study has several.
    pub network: Place,
    /// What it is trained on.
    pub train_sets: Vec<Place>,
    /// One run for each, of every train set.
    pub seeds: Vec<u64>,
}

/// Which cells there should be.
#[derive(Clone, Debug, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct MatrixPlan {
    /// In the order of the tables.
    pub networks: Vec<PlannedNetwork>,
    /// What every run is tested on, in the order of the tables.
    pub test_sets: Vec<Place>,
}

/// By which rules the numbers are made.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct MatrixOptions {
    /// Classes, compared without regard to case.
    pub classes: Vec<String>,
    /// 3D overlaps that have to be exceeded.
    pub overlaps: Vec<f64>,
    /// Which ground truths count. For data without images `all` is the same as the three of KITTI.
    pub difficulty: Difficulty,
    /// Ground truth and detections whose centre is farther away on the ground are ignored, m.
    pub max_range_m: Option<f64>,
    /// Sections of distance to report beside the whole.
    pub sections: Vec<RangeSection>,
    /// How intervals are drawn.
    pub bootstrap: BootstrapOptions,
}

impl Default for MatrixOptions {
    /// The paper's: AP at 0.5 and 0.7, up to 100 m, in three sections.
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

/// What a number says.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Quantity {
    /// KITTI's average precision over 40 recalls, in space.
    Ap40,
    /// Area under the curve with a point at every score, in space; has no ceiling for few ground truths.
    ApArea,
    /// OpenPCDet's recall: ground truths whose highest overlap with any box is over the limit. Of a two-stage network all refined regions
    /// count, before the score limit and the last suppression.
    RecallAnyBox,
    /// Hits of KITTI's matching over ground truths.
    RecallMatched,
    /// As [`Quantity::RecallAnyBox`], but of the final boxes, whatever the network.
    RecallFinalBoxes,
}

impl Quantity {
    /// In the order of [`RunScores`].
    pub const ALL: [Quantity; 5] =
        [Quantity::Ap40, Quantity::ApArea, Quantity::RecallAnyBox, Quantity::RecallMatched, Quantity::RecallFinalBoxes];
    /// Its name in files.
    pub fn key(self) -> &'static str {
        ["ap40", "ap_area", "recall_any_box", "recall_matched", "recall_final_boxes"][self as usize]
    }

    /// Those of the paper's table.
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
        })
    }
}

/// Which run.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema)]
pub struct RunId {
    /// [`Place::name`] of its network.
    pub network: String,
    /// [`Place::name`] of its train set.
    pub train_set: String,
    /// Its seed.
    pub seed: u64,
}

/// How a run stands in a cell.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case", tag = "state", content = "reason")]
pub enum RunState {
    /// Its numbers are in the cell.
    Done,
    /// There is none.
    Missing,
    /// There is one that cannot be used, and why.
    Failed(String),
}

/// A run of a cell.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct CellRun {
    /// Its seed.
    pub seed: u64,
    /// How it stands.
    #[serde(flatten)]
    pub state: RunState,
}

/// What a run's number is.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct RunNumber {
    /// The run's seed.
    pub seed: u64,
    /// Percent; `None` where undefined.
    pub value: Option<f64>,
}

/// One number of a cell, over its runs.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct CellNumber {
    /// Class name.
    pub class: String,
    /// Section of distance; `None`: the whole.
    pub section: Option<RangeSection>,
    /// What the number says.
    pub quantity: Quantity,
    /// 3D overlap that has to be exceeded.
    pub overlap: f64,
    /// Ground truths of the test set that count; `None` where only the runs' numbers are known.
    pub n_gt: Option<i64>,
    /// For [`Quantity::Ap40`], the most that a perfect detector gets: (n - 1) / 40, percent.
    pub ceiling: Option<f64>,
    /// Mean over the runs, percent; `None` where undefined.
    pub mean: Option<f64>,
    /// Standard deviation over the runs with divisor n, percent; `None` with fewer than two.
    pub deviation: Option<f64>,
    /// Bootstrap interval of the mean over seeds and frames; over frames alone where there is one run.
    pub interval: Option<Interval>,
    /// The runs behind the mean.
    pub of_runs: Vec<RunNumber>,
    /// What the paper prints, where this cell is one of the paper's.
    pub published: Option<Published>,
}

/// One pairing of train set and test set of one network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Cell {
    /// [`Place::name`] of the network.
    pub network: String,
    /// [`Place::name`] of the train set.
    pub train_set: String,
    /// [`Place::name`] of the test set.
    pub test_set: String,
    /// Test frames; `None` without a run.
    pub frames: Option<usize>,
    /// Every run that should be there.
    pub runs: Vec<CellRun>,
    /// By class, section, overlap, quantity; empty without a run.
    pub numbers: Vec<CellNumber>,
}

impl Cell {
    /// Runs whose numbers are in the cell.
    pub fn n_done(&self) -> usize {
        self.runs.iter().filter(|run| run.state == RunState::Done).count()
    }

    /// The number of a class, section, quantity and overlap.
    pub fn number(
        &self,
        class: &str,
        section: Option<RangeSection>,
        quantity: Quantity,
        overlap: f64,
    ) -> Option<&CellNumber> {
        self.numbers
            .iter()
            .find(|n| n.class == class && n.section == section && n.quantity == quantity && n.overlap == overlap)
    }
}

/// What a network loses on a test set because it was trained on another set: the number of the cell that was trained on the test
/// set's own training part, less that of this cell. The paper's domain shift.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Gap {
    /// [`Place::name`] of the network.
    pub network: String,
    /// [`Place::name`] of the test set.
    pub test_set: String,
    /// [`Place::name`] of the train set whose number is taken off.
    pub train_set: String,
    /// [`Place::name`] of the train set that it is compared to: the test set's own, or a later one of the study.
    pub compared_to: String,
    /// Class name.
    pub class: String,
    /// Section of distance; `None`: the whole.
    pub section: Option<RangeSection>,
    /// What is compared.
    pub quantity: Quantity,
    /// 3D overlap that has to be exceeded.
    pub overlap: f64,
    /// Difference of the means, points of percent.
    pub gap: f64,
    /// Bootstrap interval: the same frames are drawn for both, seeds for each.
    pub interval: Option<Interval>,
}

/// All cells.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Matrix {
    /// [`MATRIX_SCHEMA`].
    pub schema: String,
    /// What was asked for.
    pub plan: MatrixPlan,
    /// By which rules.
    pub options: MatrixOptions,
    /// By network, train set, test set, in the order of the plan.
    pub cells: Vec<Cell>,
    /// By network, test set, train set.
    pub gaps: Vec<Gap>,
    /// What to know before reading the numbers.
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

    /// The matrix as JSON.
    ///
    /// # Panics
    /// Never: all of it is plain data.
    pub fn to_json(&self) -> String {
        let mut text = serde_json::to_string_pretty(self).expect("a matrix is plain data");
        text.push('\n');
        text
    }

    /// Columns of the tables: those of the paper's, and the recall of the final boxes where a network has another one besides.
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
        self.paper_columns().into_iter().chain(of_final).collect()
    }

    /// Columns of the paper's table: AP at each overlap, then recall at each.
    fn paper_columns(&self) -> Vec<(Quantity, f64)> {
        Quantity::PAPER.iter().flat_map(|q| self.options.overlaps.iter().map(|overlap| (*q, *overlap))).collect()
    }
}

/// As the paper writes numbers: two digits behind the point at most, one at least.
pub(crate) fn paper_number(value: f64) -> String {
    let text = format!("{value:.2}");
    text.strip_suffix('0').map_or(text.clone(), String::from)
}

/// `mean (deviation)` as in the paper's table; a dash for what is not there.
pub(crate) fn paper_cell(mean: Option<f64>, deviation: Option<f64>) -> String {
    match (mean, deviation) {
        (Some(mean), Some(deviation)) => format!("{} ({})", paper_number(mean), paper_number(deviation)),
        (Some(mean), None) => paper_number(mean),
        (None, _) => "-".into(),
    }
}
