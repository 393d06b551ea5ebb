//! A cell of the matrix: the runs of a network and a train set on a test set, with their values.

use super::{Published, Quantity, Reference};
use crate::RangeSection;
use crate::bootstrap::Interval;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Identifies a run.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema)]
pub struct RunId {
    /// [`Place::name`] of its network.
    pub network: String,
    /// [`Place::name`] of its train set.
    pub train_set: String,
    /// Its seed.
    pub seed: u64,
}

/// State of a run in a cell.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case", tag = "state", content = "reason")]
pub enum RunState {
    /// Its scores are included in the cell.
    Done,
    /// It does not exist.
    Missing,
    /// It exists but cannot be used, with the reason.
    Failed(String),
}

/// A run of a cell.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct CellRun {
    /// Its seed.
    pub seed: u64,
    /// Its state.
    #[serde(flatten)]
    pub state: RunState,
}

/// Value of a metric for one run.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct RunNumber {
    /// The run's seed.
    pub seed: u64,
    /// Percent; `None` where undefined.
    pub value: Option<f64>,
}

/// Value of a metric for a cell, over its runs.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct CellNumber {
    /// Class name.
    pub class: String,
    /// Range section; `None`: full range.
    pub section: Option<RangeSection>,
    /// The metric.
    pub quantity: Quantity,
    /// 3D IoU threshold.
    pub overlap: f64,
    /// Number of counted ground truths in the test set; `None` if only the runs' values are known.
    pub n_gt: Option<i64>,
    /// Upper bound for [`Quantity::Ap40`]: (n - 1) / 40, percent.
    pub ceiling: Option<f64>,
    /// Mean over the runs, percent; `None` where undefined.
    pub mean: Option<f64>,
    /// Standard deviation over the runs with divisor n, percent; `None` with fewer than two.
    pub deviation: Option<f64>,
    /// Bootstrap interval of the mean over seeds and frames; over frames only if there is one run.
    pub interval: Option<Interval>,
    /// Values of the single runs.
    pub of_runs: Vec<RunNumber>,
    /// The paper's value, if this cell is in the paper.
    pub published: Option<Published>,
}

/// One combination of network, train set and test set.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Cell {
    /// [`Place::name`] of the network.
    pub network: String,
    /// [`Place::name`] of the train set.
    pub train_set: String,
    /// [`Place::name`] of the test set.
    pub test_set: String,
    /// Number of test frames; `None` without a run.
    pub frames: Option<usize>,
    /// All planned runs.
    pub runs: Vec<CellRun>,
    /// By class, section, overlap and metric; empty without a run.
    pub numbers: Vec<CellNumber>,
    /// The same against repaired labels, where a diagnosis corrected the labels of the test set. The intervals hold the
    /// uncertainty of the correction as well.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub of_repaired_labels: Vec<CellNumber>,
    /// The same against the true boxes, where the labels of the test set were made automatically and the truth is
    /// known.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub of_true_boxes: Vec<CellNumber>,
}

impl Cell {
    /// Number of runs whose scores are included.
    pub fn n_done(&self) -> usize {
        self.runs.iter().filter(|run| run.state == RunState::Done).count()
    }

    /// The value for a class, section, metric and overlap.
    pub fn number(
        &self,
        class: &str,
        section: Option<RangeSection>,
        quantity: Quantity,
        overlap: f64,
    ) -> Option<&CellNumber> {
        self.number_of(Reference::Labels, class, section, quantity, overlap)
    }

    /// The value against a reference for a class, section, metric and overlap.
    pub fn number_of(
        &self,
        reference: Reference,
        class: &str,
        section: Option<RangeSection>,
        quantity: Quantity,
        overlap: f64,
    ) -> Option<&CellNumber> {
        self.numbers_of(reference)
            .iter()
            .find(|n| n.class == class && n.section == section && n.quantity == quantity && n.overlap == overlap)
    }

    /// All values against a reference.
    pub fn numbers_of(&self, reference: Reference) -> &[CellNumber] {
        match reference {
            Reference::Labels => &self.numbers,
            Reference::RepairedLabels => &self.of_repaired_labels,
            Reference::TrueBoxes => &self.of_true_boxes,
        }
    }

    /// The references of this cell: labels, and what is known to be closer to the truth.
    pub fn references(&self) -> impl Iterator<Item = Reference> {
        let has = |reference: &Reference| *reference == Reference::Labels || !self.numbers_of(*reference).is_empty();
        Reference::ALL.into_iter().filter(has)
    }
}
