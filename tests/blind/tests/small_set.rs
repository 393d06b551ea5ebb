//! A small blind set with fixed seeds: hidden causes must be named, and nothing else.
//!
//! A few cases of the large set, `cargo xtask bench blind`, as a regression test of the diagnosis.

use diagnose::{Cause, Diagnosis, Verdict};
use lidarshift_blind::{CAUSES, Kind, draw_case, write_case};
use rayon::prelude::*;
use score::{CaseSize, Outcome, score};
use trials::diagnosed;

fn outcome(seed: u64, kind: Kind) -> Outcome {
    let folder = tempfile::tempdir().unwrap();
    let truth = write_case(&draw_case(seed, kind, CaseSize::USUAL), folder.path()).unwrap();
    let found = diagnosed(folder.path(), "simulated").unwrap();
    assert_eq!(unanswered(&found.diagnosis), [], "seed {seed}");
    score(&truth, &serde_json::to_value(&found.diagnosis).unwrap(), 0.0)
}

/// Causes of which a diagnosis of comparable data says nothing: neither found, nor looked for, nor beyond these data.
fn unanswered(diagnosis: &Diagnosis) -> Vec<Cause> {
    if diagnosis.verdict == Verdict::NotScenarioIdentical {
        return vec![];
    }
    let is_answered = |cause: &Cause| {
        *cause == Cause::Unexplained
            || diagnosis.considered.iter().any(|c| c.cause.cause == *cause)
            || diagnosis.not_identifiable.iter().any(|n| n.cause == *cause)
    };
    Cause::ALL.iter().copied().filter(|cause| !is_answered(cause)).collect()
}

fn single(cause: &str) -> Kind {
    Kind::Single(CAUSES.iter().position(|c| *c == cause).unwrap())
}

#[test]
fn what_is_hidden_is_named() {
    let cases = [
        (1, Kind::Null, "clean"),
        (2, Kind::Null, "clean"),
        (3, Kind::Shuffled, "refused"),
        (220, single("range_noise"), "right"),
        (221, single("range_bias"), "right"),
        (226, single("random_dropout"), "right"),
        (60010, Kind::OffCatalogue(3), "right"),
        (60011, Kind::OffCatalogue(0), "unexplained"),
        (60012, Kind::OffCatalogue(2), "unexplained"),
    ];
    let wrong: Vec<String> = cases
        .par_iter()
        .filter_map(|&(seed, kind, want)| {
            let o = outcome(seed, kind);
            let mismatch = format!(
                "{seed}: {:?} gives {} ({:?} {:?}), not {want}",
                o.truth.hidden,
                o.grade(),
                o.named,
                o.ambiguous
            );
            (o.grade() != want).then_some(mismatch)
        })
        .collect();
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}
