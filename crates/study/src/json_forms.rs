//! Forms of the JSON files of a study.

use crate::cost::{COSTS_SCHEMA, CostsFile};
use crate::detections::{CELL_SCHEMA, DetectionCell, RUN_FEATURES_SCHEMA, RunFeatures};
use crate::features::{FEATURES_SCHEMA, FeatureResults};
use crate::folder::{ORIGIN_SCHEMA, Origin};
use crate::frozen::{self, FrozenCell};
use crate::plan::{PLAN_SCHEMA, PlanReport};
use crate::run_state::{FAILURE_SCHEMA, Failure};
use crate::status::{STATUS_SCHEMA, StatusReport};
use data::JsonForm;

/// The forms of the JSON files of this crate.
pub fn json_forms() -> Vec<JsonForm> {
    vec![
        JsonForm::of::<StatusReport>("study-status", "`study status --json`", Some(STATUS_SCHEMA)),
        JsonForm::of::<PlanReport>("study-plan", "`study plan --json`", Some(PLAN_SCHEMA)),
        JsonForm::of::<FeatureResults>(
            "features",
            "`features.json` of `study`, `eval tsne --json`",
            Some(FEATURES_SCHEMA),
        ),
        JsonForm::of::<RunFeatures>(
            "run-features",
            "`features/SET.json` of a run of a study",
            Some(RUN_FEATURES_SCHEMA),
        ),
        JsonForm::of::<DetectionCell>("detection-cell", "`cell.json` of the detections of a run", Some(CELL_SCHEMA)),
        JsonForm::of::<FrozenCell>("frozen-cell", "`cell.json` of a frozen detector", Some(frozen::CELL_SCHEMA)),
        JsonForm::of::<Failure>("failed-run", "`failed.json` of a run that failed", Some(FAILURE_SCHEMA)),
        JsonForm::of::<CostsFile>("study-costs", "`costs.json` of `study`", Some(COSTS_SCHEMA)),
        JsonForm::of::<Origin>("study-origin", "`origin.json` of `study`", Some(ORIGIN_SCHEMA)),
    ]
}
