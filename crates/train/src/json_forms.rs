//! Forms of the JSON files of a run folder.

use crate::metrics::Line;
use crate::provenance::{PROVENANCE_SCHEMA, Provenance};
use crate::state_file::{STATE_SCHEMA, StateFile};
use data::JsonForm;

/// The forms of the JSON files of this crate.
pub fn json_forms() -> Vec<JsonForm> {
    vec![
        JsonForm::of::<Provenance>("provenance", "`provenance.json` of `train`", Some(PROVENANCE_SCHEMA)),
        JsonForm::of::<StateFile>("run-state", "`checkpoint/state.json` of `train`", Some(STATE_SCHEMA)),
        JsonForm::of::<Line>("metrics", "a line of `metrics.jsonl` of `train`", None),
    ]
}
