//! What is reached of each finding through `extended.toml`, and which names do not hold against it.

use crate::catalogue::{Cause, Channel, Kind};
use crate::diagnosis::{Closed, Considered, Diagnosis, Finding, Gain, NotApplied, Predicted, Status, Verdict};
use crate::effects::cause_of;
use crate::extended::why_none;
use crate::search::Z_STAR;
use std::collections::BTreeMap;

/// Difference of what was promised and what was reached from which on the form of a cause does not fit.
const FORM: f64 = 0.05;

/// Share of a channel's difference that is much of it.
const MUCH: f64 = 0.5;

/// What is gone of a part of the differences, with its distances before, after and at the floor, nats a return.
pub(crate) struct Reached {
    pub(crate) distances: [f64; 3],
    pub(crate) closed: Closed,
}

/// Share of the difference in its own directions that a finding promises at least.
const MOST: f64 = 0.9;

/// Lists findings without an effect as not applied, and writes to each finding what the fits promised of its channel
/// and what was reached there. For one that acts in some directions, by its number in `places`, it is that of these. A
/// named cause whose effect was applied and surely reaches less than it promised, by more than 5 points, does not have
/// the form of the difference: it is ambiguous where another cause was significant as well, else without a name. Of
/// what the distances do not see nothing is said.
pub(crate) fn set_reached(diagnosis: &mut Diagnosis, places: &BTreeMap<usize, Reached>) {
    let without = diagnosis.findings.iter().filter(|f| f.effects.is_empty());
    let not_applied = without.map(|f| NotApplied { effect: cause_of(f).name().into(), why: why_none(f) });
    diagnosis.gain.not_applied.extend(not_applied);
    let Diagnosis { findings, gain, considered, .. } = diagnosis;
    for (number, finding) in findings.iter_mut().enumerate() {
        let place = places.get(&number);
        let Some(measured) = closed_of(gain, place, finding) else { continue };
        finding.reached = Some(measured.closed);
        finding.predicted = gain.predicted.as_ref().and_then(|p| promised(p, finding.channel));
        let Some(promised) = finding.predicted else { continue };
        let of_kind = || gain.kinds.get(&kind_of(finding)?).copied();
        let part = place.map(|place| place.distances).or_else(of_kind);
        let parts = part.and_then(|part| Some([part, *gain.channels.get(&finding.channel)?]));
        let promised = parts.map_or(promised, |parts| promised_at_least(promised, parts));
        // What is lost in its own directions is what it was found by.
        let promised = if place.is_some() { promised.max(MOST) } else { promised };
        let applied = !finding.effects.is_empty()
            && finding.effects.iter().all(|e| gain.not_applied.iter().all(|left| left.effect != e.kind()));
        // What the extended simulation makes no better is not what is wrong, if it promised to be much of it.
        let no_better = measured.closed <= 0.0 && promised > MUCH;
        let surely_less = no_better || measured.ci95.is_some_and(|[_, high]| high < promised - FORM);
        if finding.status == Status::Named && applied && surely_less && measured.closed < promised - FORM {
            finding.says.push_str(&format!(
                "; with the extended simulation {:.0} % of the difference is gone where the fit says {:.0} %: the form of \
                 this cause does not fit",
                100.0 * measured.closed.max(0.0),
                100.0 * promised
            ));
            lose_name(finding, considered);
        }
    }
    diagnosis.verdict = Verdict::of(&diagnosis.findings);
}

/// The kind of differences that a finding is about; `None` where it is about its whole channel.
fn kind_of(finding: &Finding) -> Option<Kind> {
    Kind::of(cause_of(finding)).filter(|kind| kind.channel() == finding.channel)
}

/// What is gone of the difference that a finding is about: that of its `place`, its kind or its channel.
pub(super) fn closed_of<'a>(gain: &'a Gain, place: Option<&'a Reached>, finding: &Finding) -> Option<&'a Closed> {
    match (place, kind_of(finding)) {
        (Some(place), _) => Some(&place.closed),
        (None, Some(kind)) => gain.closed_by_kind.get(&kind),
        (None, None) => gain.closed_by_channel.get(&finding.channel),
    }
}

/// Takes the name of a finding's cause back.
fn lose_name(finding: &mut Finding, considered: &[Considered]) {
    let cause = finding.cause.take();
    let rivals = considered.iter().filter(|c| c.channel == finding.channel && c.z > Z_STAR && c.nats_per_ray > 0.0);
    let named = rivals.map(|c| (c.nats_per_ray, c.cause.cause));
    // What makes another kind of differences is no other reason for this one.
    let alike = |rival: Cause| cause.is_some_and(|c| rival != c && Kind::of(rival) == Kind::of(c));
    let rival = named.filter(|(_, rival)| alike(*rival) && *rival != Cause::Unexplained);
    let rival = rival.max_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, rival)| rival);
    match (cause, rival) {
        (Some(cause), Some(rival)) => {
            (finding.status, finding.candidates) = (Status::Ambiguous, Some(vec![cause, rival]));
        }
        _ => finding.status = Status::Unexplained,
    }
}

/// Share of a channel's difference that the fits remove.
fn promised(predicted: &Predicted, channel: Channel) -> Option<f64> {
    let [before, after, floor] = *predicted.channels.get(&channel)?;
    (before > floor).then(|| (before - after) / (before - floor))
}

/// Share of a kind's difference that the fits remove at least, where they remove a share of its channel's: what they
/// leave may all be of this kind. Both come as before, after and floor.
fn promised_at_least(of_channel: f64, [kind, channel]: [[f64; 3]; 2]) -> f64 {
    let [kind, channel] = [kind, channel].map(|[before, _, floor]| before - floor);
    if kind > 0.0 { 1.0 - (1.0 - of_channel) * (channel / kind).max(1.0) } else { of_channel }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_fits_leave_of_a_channel_may_all_be_of_one_kind() {
        let channel = [1.0, 0.0, 0.0];
        let at_least = |kind: [f64; 3]| promised_at_least(0.98, [kind, channel]);
        assert!((at_least([0.2, 0.1, 0.0]) - 0.9).abs() < 1e-9);
        assert!((at_least([1.0, 0.1, 0.0]) - 0.98).abs() < 1e-9, "it is the whole channel");
        assert!((at_least([1.1, 0.1, 0.0]) - 0.98).abs() < 1e-9, "other kinds are better than the simulation");
        assert!(at_least([0.01, 0.0, 0.0]) < 0.0, "nothing is promised of so little");
        assert!((at_least([0.1, 0.0, 0.2]) - 0.98).abs() < 1e-9);
    }
}
