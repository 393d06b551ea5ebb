//! Forms of the JSON files of evaluations.

use crate::analysis::RunAnalysis;
use crate::comparison::{COMPARISON_SCHEMA, Comparison};
use crate::distance::{DISTANCES_SCHEMA, Distances, FrameDistances};
use crate::matrix::{MATRIX_SCHEMA, Matrix, PairedDifference};
use crate::targets::{TARGETS_SCHEMA, Targets};
use crate::{EvalReport, SCHEMA, STATISTICS_SCHEMA, StatisticsReport};
use data::JsonForm;

/// The forms of the JSON files of this crate.
pub fn json_forms() -> Vec<JsonForm> {
    vec![
        JsonForm::of::<EvalReport>("eval-ap", "`eval ap --json`, `eval.json` of `train`, `train --json`", Some(SCHEMA)),
        JsonForm::of::<StatisticsReport>("statistics", "`eval statistics --json`", Some(STATISTICS_SCHEMA)),
        JsonForm::of::<Matrix>(
            "matrix",
            "`matrix.json` of `study`, `study --json`, `eval matrix --json`",
            Some(MATRIX_SCHEMA),
        ),
        JsonForm::of::<Vec<(String, RunAnalysis)>>("analyses", "`analyses.json` of `study`: titles and analyses", None),
        JsonForm::of::<Distances>(
            "distances",
            "`eval distances --json`, `distances*.json` of `study`",
            Some(DISTANCES_SCHEMA),
        ),
        JsonForm::of::<Vec<FrameDistances>>("frame-distances", "`distances/frames-*.json` of `compare`", None),
        JsonForm::of::<Targets>(
            "targets",
            "an element of `eval targets --json`, `targets*.json` of `study`",
            Some(TARGETS_SCHEMA),
        ),
        JsonForm::of::<Comparison>(
            "comparison",
            "`comparison.json` of `compare`, `compare --json`",
            Some(COMPARISON_SCHEMA),
        ),
        JsonForm::of::<(Vec<PairedDifference>, Vec<String>)>(
            "paired",
            "`paired.json` of a study with frozen detectors: the differences, and warnings",
            None,
        ),
    ]
}
