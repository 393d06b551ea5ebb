//! A matrix from values that are known per run, without the detections.

use super::build::{NumberKey, cell_warnings, plan_warnings};
use super::{Cell, CellNumber, CellRun, MATRIX_SCHEMA, Matrix, MatrixOptions, MatrixPlan, Quantity, RunId, RunState};
use std::collections::BTreeMap;

/// A value of one run on one test set.
#[derive(Clone, Debug, PartialEq)]
pub struct RunValue {
    /// The run.
    pub run: RunId,
    /// [`super::Place::name`] of the test set.
    pub test_set: String,
    /// Class name.
    pub class: String,
    /// The metric.
    pub quantity: Quantity,
    /// 3D IoU threshold.
    pub overlap: f64,
    /// Percent; NaN where undefined.
    pub value: f64,
}

/// Builds the matrix from such values: means and deviations over the runs, for the full range. There are no intervals,
/// since there are no frames to resample.
pub fn from_run_values(plan: &MatrixPlan, values: &[RunValue], options: &MatrixOptions) -> Matrix {
    let mut cells = Vec::new();
    for planned in &plan.networks {
        for (train_set, test_set) in planned.train_sets.iter().flat_map(|a| plan.test_sets.iter().map(move |b| (a, b)))
        {
            let of_cell: Vec<&RunValue> = values
                .iter()
                .filter(|v| v.run.network == planned.network.name)
                .filter(|v| v.run.train_set == train_set.name && v.test_set == test_set.name)
                .collect();
            let run = |seed: &u64| {
                let done = of_cell.iter().any(|v| v.run.seed == *seed);
                CellRun { seed: *seed, state: if done { RunState::Done } else { RunState::Missing } }
            };
            let mut numbers = Vec::new();
            let keys = options.classes.iter().flat_map(|class| options.overlaps.iter().map(move |o| (class, *o)));
            for ((class, overlap), quantity) in keys.flat_map(|key| Quantity::ALL.map(|quantity| (key, quantity))) {
                let is = |v: &&&RunValue| v.class == *class && v.quantity == quantity && v.overlap == overlap;
                let runs: Vec<(u64, f64)> = of_cell.iter().filter(is).map(|v| (v.run.seed, v.value)).collect();
                if !runs.is_empty() {
                    let key = NumberKey { class: class.clone(), section: None, quantity, overlap };
                    numbers.push(CellNumber::of_runs(key, runs, [&planned.network, train_set, test_set]));
                }
            }
            cells.push(Cell {
                network: planned.network.name.clone(),
                train_set: train_set.name.clone(),
                test_set: test_set.name.clone(),
                frames: None,
                runs: planned.seeds.iter().map(run).collect(),
                numbers,
                of_repaired_labels: Vec::new(),
                of_true_boxes: Vec::new(),
            });
        }
    }
    let mut warnings = plan_warnings(plan);
    warnings.extend(cells.iter().flat_map(|cell| cell_warnings(cell, &BTreeMap::new())));
    Matrix {
        schema: MATRIX_SCHEMA.into(),
        plan: plan.clone(),
        options: options.clone(),
        cells,
        gaps: Vec::new(),
        splits: Vec::new(),
        power: Vec::new(),
        warnings,
    }
}
