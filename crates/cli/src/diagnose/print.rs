//! What `lidarshift diagnose` prints.

use crate::{errln, outln};
use diagnose::{DetectorGain, Diagnosis, Gain, ParameterId, Status, Verdict};
use report::finding_name;
use std::path::Path;

pub(super) fn print_diagnosis(diagnosis: &Diagnosis, out: &Path, corrected: usize) {
    for note in &diagnosis.notes {
        errln!("note: {note}");
    }
    let statuses: Vec<Status> = diagnosis.findings.iter().map(|f| f.status).collect();
    outln!("verdict: {}", verdict_text(diagnosis.verdict, &statuses));
    if diagnosis.verdict == Verdict::NothingFound && !diagnosis.minimum_detectable.is_empty() {
        outln!("detectable effect sizes:");
        for (cause, m) in &diagnosis.minimum_detectable {
            outln!("  {cause}: {} {:.4} {}", m.parameter, m.value, m.unit);
        }
    }
    for f in &diagnosis.findings {
        let name = finding_name(f);
        outln!("{name}: {}", f.says);
        for (parameter, p) in f.parameters.iter().filter(|(id, _)| matches!(id, ParameterId::Of(_))) {
            outln!("  {parameter} = {:.4} {} ({:.4} to {:.4})", p.estimate, p.unit, p.ci95[0], p.ci95[1]);
        }
        if let Some(how) = &f.separate_by {
            match f.status {
                Status::NotIdentifiable => outln!("  to tell it, record {how}"),
                _ => outln!("  to distinguish these causes: {how}"),
            }
        }
    }
    print_gain(&diagnosis.gain, "extended.toml");
    if !diagnosis.not_identifiable.is_empty() {
        outln!("these data cannot identify:");
        for alike in diagnosis.not_identifiable.chunk_by(|a, b| (&a.why, &a.tell_by) == (&b.why, &b.tell_by)) {
            let causes: Vec<&str> = alike.iter().map(|n| n.cause.name()).collect();
            let them = if causes.len() == 1 { "it" } else { "them" };
            outln!("  {}: {}; to identify {them}, record {}", causes.join(", "), alike[0].why, alike[0].tell_by);
        }
    }
    if corrected > 0 {
        outln!("corrected labels of {corrected} frames written to {}", out.join("label_2").display());
    }
    errln!("report.html, diagnosis.json and extended.toml written to {}", out.display());
}

/// What is gone with a list of effects, by channel, and what could not be applied.
pub(super) fn print_gain(gain: &Gain, list: &str) {
    let percent = |share: f64| format!("{:.0}", 100.0 * share);
    let between = |ci95: Option<[f64; 2]>| {
        ci95.map_or(String::new(), |[low, high]| format!(" ({} to {} %)", percent(low), percent(high)))
    };
    if let Some(closed) = gain.closed {
        outln!(
            "measured on held-out frames that were made anew with {list}: {} % of the difference is gone{}",
            percent(closed),
            between(gain.ci95)
        );
        for (channel, c) in &gain.closed_by_channel {
            outln!("  {channel}: {} %{}", percent(c.closed), between(c.ci95));
        }
    }
    for left in &gain.not_applied {
        outln!("not applied, and counted as not gone: {}: {}", left.effect, left.why);
    }
}

/// The verdict in words, with the numbers of findings by status.
fn verdict_text(verdict: Verdict, findings: &[Status]) -> String {
    let count = |status: Status| findings.iter().filter(|s| **s == status).count();
    let named = format!("{} of {} findings have a named cause", count(Status::Named), findings.len());
    let (ambiguous, unexplained) = (count(Status::Ambiguous), count(Status::Unexplained));
    let hidden = match count(Status::NotIdentifiable) {
        0 => String::new(),
        n => format!(", {n} not identifiable"),
    };
    match verdict {
        Verdict::NothingFound => "nothing found: there is no significant difference".into(),
        Verdict::Explained => format!("explained: {named}{hidden}"),
        Verdict::PartlyExplained => {
            format!("partly explained: {named}; {ambiguous} ambiguous, {unexplained} unexplained{hidden}")
        }
        Verdict::Unexplained => {
            format!("unexplained: {named}; {ambiguous} ambiguous, {unexplained} unexplained{hidden}")
        }
        Verdict::NotScenarioIdentical => {
            "not scenario-identical: the two data sets do not show the same scenes; if they show different streets on \
             purpose, give --unpaired"
                .into()
        }
        Verdict::TooFewFrames => "too few frames: nothing can be found, fitted and tested on different frames".into(),
    }
}

pub(super) fn print_gains(gains: &[DetectorGain], left_out: &[String]) {
    left_out.iter().for_each(|note| outln!("note: {note}"));
    for g in gains {
        let interval = g.ci95.map_or(String::new(), |[low, high]| format!(" ({low:.1} to {high:.1})"));
        outln!(
            "{}, {} at IoU {}: AP on measured frames is {:.1} when trained on simulated, {:.1} on extended, {:.1} on measured data; \
             gain {:+.1}{interval} over {} runs each",
            g.detector,
            g.class,
            g.overlap,
            g.before,
            g.after,
            g.ceiling,
            g.gain,
            g.runs
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_verdict_counts_the_findings_by_status() {
        use Status::{Ambiguous, Named, Unexplained};
        assert_eq!(
            verdict_text(Verdict::PartlyExplained, &[Named, Ambiguous, Named, Unexplained]),
            "partly explained: 2 of 4 findings have a named cause; 1 ambiguous, 1 unexplained"
        );
        assert_eq!(verdict_text(Verdict::Explained, &[Named]), "explained: 1 of 1 findings have a named cause");
    }
}
