//! Forms of the JSON that the commands write.

use crate::detect::{DETECTIONS_SCHEMA, Found, FoundInSet, SET_DETECTIONS_SCHEMA};
use crate::errors::{ErrorReport, SCHEMA};
use crate::export::{ONNX_SCHEMA, OnnxDescription};
use crate::simulate::{RACE_MANIFESTS_SCHEMA, RaceManifests};
use data::JsonForm;

/// The forms of all JSON files that the program writes, sorted by name. Those of exports for other programs are theirs.
pub fn json_forms() -> Vec<JsonForm> {
    let mut forms = vec![
        JsonForm::of::<ErrorReport>("error", "the last line of stderr with `--errors json`", Some(SCHEMA)),
        JsonForm::of::<Found<'_>>("detections", "`detect --json` on a cloud", Some(DETECTIONS_SCHEMA)),
        JsonForm::of::<FoundInSet>("set-detections", "`detect --json` on a data set", Some(SET_DETECTIONS_SCHEMA)),
        JsonForm::of::<RaceManifests<'_>>("race-manifests", "`simulate --json`: a race", Some(RACE_MANIFESTS_SCHEMA)),
        JsonForm::of::<OnnxDescription<'_>>(
            "onnx-detector",
            "`detector.json` of `export --to onnx`, `--json` with it",
            Some(ONNX_SCHEMA),
        ),
    ];
    forms.extend(data::json_forms());
    forms.extend(sensor::attributes::json_forms());
    forms.extend(::simulate::json_forms());
    forms.extend(::twin::json_forms());
    forms.extend(exchange::json_forms());
    forms.extend(::diagnose::json_forms());
    forms.extend(::eval::json_forms());
    forms.extend(::train::json_forms());
    forms.extend(::study::json_forms());
    forms.sort_by_key(|form| form.name);
    forms
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn names_and_versions_are_unique() {
        let forms = json_forms();
        let names: BTreeSet<&str> = forms.iter().map(|form| form.name).collect();
        assert_eq!(names.len(), forms.len());
        let versioned: Vec<&JsonForm> = forms.iter().filter(|form| form.version.is_some()).collect();
        let versions: BTreeSet<&str> = versioned.iter().filter_map(|form| form.version).collect();
        assert_eq!(versions.len(), versioned.len());
        for form in versioned {
            let schema = form.schema();
            assert_eq!(schema["properties"]["schema"]["const"], form.version.unwrap(), "{}", form.name);
        }
    }
}
