//! The matrix as CSV: one line per value.

use super::{Matrix, markdown::runs};
use crate::csv_text;

const COLUMNS: [&str; 20] = [
    "network",
    "train_set",
    "test_set",
    "runs",
    "frames",
    "reference",
    "class",
    "from_m",
    "to_m",
    "quantity",
    "overlap",
    "n_gt",
    "ceiling",
    "mean",
    "deviation",
    "low",
    "high",
    "paper_mean",
    "paper_deviation",
    "of_runs",
];

impl Matrix {
    /// One line per value of every cell, with the values of the single runs; a cell without a run has one line without
    /// values.
    pub fn to_csv(&self) -> String {
        let mut lines: Vec<Vec<String>> = Vec::new();
        let number = |v: Option<f64>| v.map_or(String::new(), |v| v.to_string());
        for cell in &self.cells {
            let head = [cell.network.clone(), cell.train_set.clone(), cell.test_set.clone(), runs(cell)];
            let frames = cell.frames.map_or(String::new(), |n| n.to_string());
            if cell.numbers.is_empty() {
                let empty = std::iter::repeat_n(String::new(), COLUMNS.len() - head.len());
                lines.push(head.iter().cloned().chain(empty).collect());
            }
            for (reference, n) in cell.references().flat_map(|r| cell.numbers_of(r).iter().map(move |n| (r, n))) {
                let of_runs = n.of_runs.iter().map(|run| format!("{}:{}", run.seed, number(run.value)));
                let fields = [
                    frames.clone(),
                    reference.key().into(),
                    n.class.clone(),
                    number(n.section.map(|s| s.from_m)),
                    number(n.section.map(|s| s.to_m)),
                    n.quantity.key().into(),
                    n.overlap.to_string(),
                    n.n_gt.map_or(String::new(), |n| n.to_string()),
                    number(n.ceiling),
                    number(n.mean),
                    number(n.deviation),
                    number(n.interval.map(|i| i.low)),
                    number(n.interval.map(|i| i.high)),
                    number(n.published.map(|p| p.mean)),
                    number(n.published.map(|p| p.deviation)),
                    of_runs.collect::<Vec<_>>().join(" "),
                ];
                lines.push(head.iter().cloned().chain(fields).collect());
            }
        }
        csv_text(&COLUMNS, &lines)
    }
}
