//! The list of effects of a diagnosis, with what it gains.

use super::reached::{set_reached, take_back_differences};
use super::verification::{Remake, Verification, View};
use crate::diagnosis::{Diagnosis, Gain, Verdict};
use crate::error::DiagnoseError;
use crate::extended::extended_toml;
use sensor::EffectList;
use sensor::effects::MadeFrom;
use std::collections::BTreeMap;
use std::path::Path;

/// The text of `extended.toml`, whose gain goes into the diagnosis, and a view of it in one frame. Findings that would
/// make a difference where there is none are taken back, and the gain of the others is measured.
pub(super) fn with_gain(
    diagnosis: &mut Diagnosis,
    verification: &Verification,
    made_from: &MadeFrom,
    remake: &dyn Remake,
) -> Result<(String, Option<View>), DiagnoseError> {
    loop {
        let extended = extended_toml(diagnosis, Some(made_from));
        let view = measure_gain(diagnosis, verification, &extended, remake)?;
        if !take_back_differences(diagnosis, verification.least()) {
            return Ok((extended, view));
        }
        diagnosis.verdict = Verdict::of(&diagnosis.findings);
    }
}

/// Measures the gain of what was found through the text of `extended.toml`, on the pair as it was recorded. Returns a
/// view of it in one frame.
fn measure_gain(
    diagnosis: &mut Diagnosis,
    verification: &Verification,
    extended: &str,
    remake: &dyn Remake,
) -> Result<Option<View>, DiagnoseError> {
    let effects = EffectList::parse(extended, Path::new("extended.toml"))?;
    let (gain, places, view) = match diagnosis.findings.is_empty() {
        true => (verification.without_extension(), BTreeMap::new(), None),
        false => {
            let prepared = remake.with(&effects)?;
            let extended = verification.of(&effects, &prepared)?;
            verification.measure_curves(&mut diagnosis.findings, &extended);
            let view = verification.view(&effects, &diagnosis.findings, &prepared)?;
            (extended.gain, extended.places, view)
        }
    };
    diagnosis.gain = Gain { predicted: diagnosis.gain.predicted.take(), ..gain };
    set_reached(diagnosis, &places);
    Ok(view)
}
