//! Causes that a comparison cannot tell, as the simulated side was made of the measured one.

use crate::diagnosis::{Diagnosis, Unidentifiable, Verdict};

/// Gives findings that have one of these causes, or may have it, the status `not_identifiable`, with the reason and
/// what can tell, and lists these causes.
pub(super) fn take_names(diagnosis: &mut Diagnosis, baked_in: &[Unidentifiable]) {
    for finding in &mut diagnosis.findings {
        if let Some(known) = baked_in.iter().find(|b| finding.may_be(b.cause)) {
            finding.becomes_not_identifiable(&format!(" ({}): {}", known.cause, known.why), &known.tell_by);
        }
    }
    diagnosis.cannot_tell(baked_in.iter().cloned());
    diagnosis.verdict = Verdict::of(&diagnosis.findings);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::catalogue::{Cause, Channel, Covariate, Family, Quantity};
    use crate::curve::Curve;
    use crate::diagnosis::{Finding, FindingGain, Minimum, Status};
    use crate::engine::report::refused;
    use std::collections::BTreeMap;

    fn finding(cause: Option<Cause>, candidates: Option<Vec<Cause>>) -> Finding {
        Finding {
            status: if cause.is_some() { Status::Named } else { Status::Ambiguous },
            cause,
            candidates,
            family: Family::RangeError,
            parameters: BTreeMap::new(),
            confidence: 1.0,
            channel: Channel::Residuals,
            covariate: Covariate::Range,
            gain: FindingGain::default(),
            predicted: None,
            reached: None,
            says: "ranges are too long".into(),
            separate_by: None,
            curve: Curve::default(),
            effects: vec![],
        }
    }

    #[test]
    fn a_cause_of_both_sides_loses_its_name_and_others_keep_it() {
        let mut diagnosis = refused(vec![]);
        diagnosis.findings = vec![
            finding(Some(Cause::RangeBias), None),
            finding(Some(Cause::BeamRangeOffset), None),
            finding(None, Some(vec![Cause::SignalDropout, Cause::RangeBias])),
        ];
        for cause in [Cause::RangeBias, Cause::RandomDropout] {
            diagnosis.minimum_detectable.insert(cause, Minimum::new(Quantity::Share, 0.1));
        }
        let baked_in = Unidentifiable {
            cause: Cause::RangeBias,
            why: "the map moves with it".into(),
            tell_by: "a known wall".into(),
        };
        take_names(&mut diagnosis, &[baked_in]);
        let [bias, rows, either] = &diagnosis.findings[..] else { panic!("three findings") };
        assert_eq!((bias.status, bias.cause), (Status::NotIdentifiable, None));
        assert_eq!(bias.candidates, Some(vec![Cause::RangeBias]));
        assert_eq!(bias.says, "ranges are too long; not identifiable (range_bias): the map moves with it");
        assert_eq!(bias.separate_by.as_deref(), Some("a known wall"));
        assert_eq!((rows.status, rows.cause), (Status::Named, Some(Cause::BeamRangeOffset)));
        assert_eq!(either.status, Status::NotIdentifiable);
        assert_eq!(either.candidates.as_ref().map(Vec::len), Some(2));
        assert_eq!(diagnosis.minimum_detectable.keys().collect::<Vec<_>>(), [&Cause::RandomDropout]);
        assert_eq!(diagnosis.verdict, Verdict::Explained);
        diagnosis.findings.retain(|f| f.status == Status::NotIdentifiable);
        assert_eq!(Verdict::of(&diagnosis.findings), Verdict::Unexplained);
    }
}
