//! Distances of single frames, kept separately so that frames can be resampled together with those of another pair.

use super::{Measure, MeasureRow, Part};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// One measure on one part, for every frame pair.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct FrameDistances {
    /// Subset of points.
    pub part: Part,
    /// Distance measure.
    pub measure: Measure,
    /// In the order of the frames; `None` where one cloud has no such points.
    pub values: Vec<Option<f64>>,
    /// As [`MeasureRow::floor`].
    pub floor: Option<f64>,
}

/// The distances of all frames: by part, then by measure, as `rows`. `found` holds, for each frame and part, the
/// distances in the order of [`Measure::ALL`].
pub(super) fn by_frame(rows: &[MeasureRow], found: &[Vec<Option<[f64; Measure::ALL.len()]>>]) -> Vec<FrameDistances> {
    let of_row = |(i, row): (usize, &MeasureRow)| {
        let (k, m) = (i / Measure::ALL.len(), i % Measure::ALL.len());
        let values = found.iter().map(|parts| parts[k].map(|distances| distances[m])).collect();
        FrameDistances { part: row.part, measure: row.measure, values, floor: row.floor }
    };
    rows.iter().enumerate().map(of_row).collect()
}
