//! Causes that a pair cannot tell since the data lack what would show them.
//!
//! Every cause of the catalogue has an answer: it is found, it was looked for (see [`Diagnosis::considered`]), or it is
//! listed here with the reason.

use crate::catalogue::Cause;
use crate::diagnosis::{Diagnosis, Unidentifiable};

/// Causes that need the same of the data.
struct Need {
    causes: &'static [Cause],
    /// What is lacking.
    why: &'static str,
    /// What to record.
    tell_by: &'static str,
}

/// What rows show. Without rows these causes are searched in vain.
const ROWS: Need = Need {
    causes: &[
        Cause::BeamElevationOffset,
        Cause::BeamIntensity,
        Cause::BeamRangeOffset,
        Cause::MixedPixels,
        Cause::PacketLoss,
    ],
    why: "no sensor has rows that are known",
    tell_by: "a sensor with rows, and give its file with the scan pattern (--sensor)",
};

/// The others: their searches do not run where something is lacking.
const OTHERS: [Need; 4] = [
    Need {
        causes: &[
            Cause::BeamIntensity,
            Cause::Blooming,
            Cause::BrightTargetDropout,
            Cause::IntensityLaw,
            Cause::ReflectivityWalk,
        ],
        why: "the two sides do not both have intensities that tell surfaces apart",
        tell_by: "intensities, and let the simulation write them as well",
    },
    Need {
        causes: &[Cause::EgoAttitude],
        why: "the speed of the ego vehicle does not change, or is not known",
        tell_by: "frames at several speeds, with rising numbers as ids",
    },
    Need {
        causes: &[Cause::LabelOffset, Cause::TimeOffset, Cause::WrongShape],
        why: "too few objects are labelled on both sides, or too few returns lie on them",
        tell_by: "frames with more labelled vehicles near the sensors",
    },
    Need {
        causes: &[Cause::GroundError],
        why: "too little ground is seen on both sides",
        tell_by: "a drive on a road that the sensors see",
    },
];

/// Adds what these data lack to the causes that cannot be identified; `rows` says whether rows of a sensor are known.
pub(super) fn add_what_is_lacking(diagnosis: &mut Diagnosis, rows: bool) {
    if !rows {
        diagnosis.considered.retain(|c| !ROWS.causes.contains(&c.cause.cause));
    }
    for need in (!rows).then_some(&ROWS).into_iter().chain(&OTHERS) {
        let lacking = need.causes.iter().filter(|cause| !is_answered(diagnosis, **cause));
        let entry =
            |cause: &Cause| Unidentifiable { cause: *cause, why: need.why.into(), tell_by: need.tell_by.into() };
        let entries: Vec<Unidentifiable> = lacking.map(entry).collect();
        diagnosis.cannot_tell(entries);
    }
}

/// Whether a cause was found, was looked for or is listed as one that cannot be identified.
fn is_answered(diagnosis: &Diagnosis, cause: Cause) -> bool {
    diagnosis.findings.iter().any(|f| f.may_be(cause))
        || diagnosis.considered.iter().any(|c| c.cause.cause == cause)
        || diagnosis.not_identifiable.iter().any(|n| n.cause == cause)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::catalogue::{Channel, Quantity};
    use crate::diagnosis::{Considered, Minimum};
    use crate::engine::report::refused;

    /// A diagnosis that looked for these causes.
    fn looked_for(causes: impl Iterator<Item = Cause>) -> Diagnosis {
        let considered = |cause: Cause| Considered {
            cause: cause.into(),
            channel: Channel::Hits,
            nats_per_ray: 0.0,
            z: 0.0,
            outcome: "no such place".into(),
        };
        Diagnosis { considered: causes.map(considered).collect(), ..refused(vec![]) }
    }

    #[test]
    fn what_was_not_looked_for_is_not_identifiable() {
        let mut all = looked_for(Cause::ALL.iter().copied());
        add_what_is_lacking(&mut all, true);
        assert!(all.not_identifiable.is_empty());
        let without = [Cause::Blooming, Cause::EgoAttitude];
        let mut some = looked_for(Cause::ALL.iter().copied().filter(|c| !without.contains(c)));
        add_what_is_lacking(&mut some, true);
        assert_eq!(some.not_identifiable.iter().map(|n| n.cause).collect::<Vec<_>>(), without);
    }

    #[test]
    fn without_rows_their_causes_are_listed_once_and_nothing_of_them_is_detectable() {
        let mut diagnosis = looked_for(Cause::ALL.iter().copied().filter(|c| *c != Cause::BeamIntensity));
        for cause in [Cause::BeamRangeOffset, Cause::RangeBias] {
            diagnosis.minimum_detectable.insert(cause, Minimum::new(Quantity::StdM, 0.01));
        }
        add_what_is_lacking(&mut diagnosis, false);
        assert_eq!(diagnosis.not_identifiable.iter().map(|n| n.cause).collect::<Vec<_>>(), ROWS.causes);
        assert_eq!(diagnosis.minimum_detectable.keys().collect::<Vec<_>>(), [&Cause::RangeBias]);
        assert!(diagnosis.considered.iter().all(|c| !ROWS.causes.contains(&c.cause.cause)));
    }
}
