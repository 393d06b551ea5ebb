//! Forms of the JSON files of data sets that are made here.

use crate::race::{RACE_MANIFEST_SCHEMA, RaceManifest};
use crate::resim::{RESIM_MANIFEST_SCHEMA, ResimManifest};
use crate::street::{MANIFEST_SCHEMA, Manifest};
use data::JsonForm;

/// The forms of the JSON files of this crate.
pub fn json_forms() -> Vec<JsonForm> {
    vec![
        JsonForm::of::<RaceManifest>(
            "race-dataset",
            "`manifest.json` of `simulate`: a race",
            Some(RACE_MANIFEST_SCHEMA),
        ),
        JsonForm::of::<Manifest>(
            "simulated-dataset",
            "`manifest.json` of `simulate`: streets; `simulate --json`",
            Some(MANIFEST_SCHEMA),
        ),
        JsonForm::of::<ResimManifest>(
            "resim-dataset",
            "`manifest.json` of `resim`, `resim --json`",
            Some(RESIM_MANIFEST_SCHEMA),
        ),
    ]
}
