//! What is reached of each finding through `extended.toml`, and which names do not hold against it.

use crate::catalogue::{Cause, Channel, Kind, ParameterId, Quantity};
use crate::diagnosis::{
    Closed, Considered, Diagnosis, Finding, Gain, NotApplied, Parameter, Predicted, Status, Verdict,
};
use crate::effects::cause_of;
use crate::extended::why_none;
use crate::search::Z_STAR;
use sensor::Effect;
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

/// Parameters that an effect is proportional to.
const AMPLITUDES: [Quantity; 17] = [
    Quantity::DensityPerM,
    Quantity::DivergenceRad,
    Quantity::DriftM,
    Quantity::ForwardM,
    Quantity::LeftM,
    Quantity::Loss,
    Quantity::OffsetM,
    Quantity::OffsetS,
    Quantity::PerM,
    Quantity::PitchDeg,
    Quantity::Rate,
    Quantity::RollDeg,
    Quantity::Scale,
    Quantity::StdDeg,
    Quantity::StdM,
    Quantity::UpM,
    Quantity::YawDeg,
];

/// Share of a difference that is left where the true amplitude is at the far end of its interval: distances grow with
/// the square of what is not corrected. Of several amplitudes that of the one that is known best.
fn left_by_errors(parameters: &BTreeMap<ParameterId, Parameter>) -> f64 {
    let amplitudes = AMPLITUDES.iter().filter_map(|q| parameters.get(&ParameterId::Of(*q)));
    let left = |p: &Parameter| {
        let far = p.ci95.iter().map(|end| end * p.estimate.signum()).fold(p.estimate.abs(), f64::max);
        (1.0 - p.estimate.abs() / far.max(1e-300)).powi(2)
    };
    amplitudes.filter(|p| p.estimate != 0.0).map(left).reduce(f64::min).unwrap_or(0.0)
}

/// Lists findings without an effect as not applied, and writes to each finding what the fits promised of its channel
/// and what was reached there. For one that acts in some directions, by its number in `places`, it is that of these. A
/// named cause whose effect was applied and surely reaches less than it promised, by more than 5 points and what the
/// interval of its size explains, does not have the form of the difference: it is ambiguous where another cause was
/// significant as well, else without a name. Of what the distances do not see nothing is said.
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
        let part = place.map(|place| place.distances).or_else(|| distances_of_kind(gain, finding));
        let parts = part.and_then(|part| Some([part, *gain.channels.get(&finding.channel)?]));
        let promised = parts.map_or(promised, |parts| promised_at_least(promised, parts));
        // What is lost in its own directions is what it was found by.
        let promised = if place.is_some() { promised.max(MOST) } else { promised };
        let applied = is_applied(finding, gain);
        // What the extended simulation makes no better is not what is wrong, if it promised to be much of it.
        let no_better = measured.closed <= 0.0 && promised > MUCH;
        let least = promised - FORM - left_by_errors(&finding.parameters);
        let surely_less = no_better || measured.ci95.is_some_and(|[_, high]| high < least);
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

/// Distances before, after and at the floor of the kind of differences that a finding is about.
fn distances_of_kind(gain: &Gain, finding: &Finding) -> Option<[f64; 3]> {
    gain.kinds.get(&kind_of(finding)?).copied()
}

/// What is gone of the difference that a finding is about: that of its `place`, its kind or its channel.
pub(super) fn closed_of<'a>(gain: &'a Gain, place: Option<&'a Reached>, finding: &Finding) -> Option<&'a Closed> {
    match (place, kind_of(finding)) {
        (Some(place), _) => Some(&place.closed),
        (None, Some(kind)) => gain.closed_by_kind.get(&kind),
        (None, None) => gain.closed_by_channel.get(&finding.channel),
    }
}

/// What recording tells a cause that makes a difference where there was none.
const TELL_BY: &str = "recordings whose poses are known better, so that both sides see the same surfaces";

/// Takes back the findings with which the extended simulation differs from the measured side by more than `least` nats
/// a return in what they are about, where the simulation does not differ from it: they are no gain on any other frame.
/// Says whether there were any.
pub(crate) fn take_back_differences(diagnosis: &mut Diagnosis, least: f64) -> bool {
    let Diagnosis { findings, gain, .. } = diagnosis;
    let mut taken = false;
    for finding in findings.iter_mut().filter(|f| f.reached.is_none() && is_applied(f, gain)) {
        let of_channel = || gain.channels.get(&finding.channel).copied();
        let part = distances_of_kind(gain, finding).or_else(of_channel);
        let Some([before, after, floor]) = part else { continue };
        if before - floor < least && after - before.max(floor) > least {
            let why = ": in held-out frames the two sides do not differ by it, and the extended simulation would";
            finding.becomes_not_identifiable(why, TELL_BY);
            taken = true;
        }
    }
    taken
}

/// Whether all effects of a finding were applied.
fn is_applied(finding: &Finding, gain: &Gain) -> bool {
    let left_out = |e: &Effect| gain.not_applied.iter().any(|left| left.effect == e.kind());
    !finding.effects.is_empty() && !finding.effects.iter().any(left_out)
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
    use crate::catalogue::{Covariate, Unit};
    use crate::curve::Curve;
    use crate::diagnosis::{FindingGain, SCHEMA};
    use sensor::effects::RangeNoise;

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

    /// Range noise that was applied, with distances of roughness before, after and at the floor.
    fn noise_with(distances: [f64; 3]) -> Diagnosis {
        let finding = Finding {
            status: Status::Named,
            cause: Some(Cause::RangeNoise),
            candidates: None,
            family: Cause::RangeNoise.family(),
            parameters: BTreeMap::new(),
            confidence: 1.0,
            channel: Channel::Roughness,
            covariate: Covariate::Range,
            gain: FindingGain::default(),
            predicted: None,
            reached: None,
            says: "ranges scatter more".into(),
            separate_by: None,
            curve: Curve::default(),
            effects: vec![Effect::RangeNoise(RangeNoise::default())],
        };
        Diagnosis {
            schema: SCHEMA.into(),
            build: String::new(),
            verdict: Verdict::Explained,
            frames: Default::default(),
            findings: vec![finding],
            minimum_detectable: Default::default(),
            gain: Gain { channels: [(Channel::Roughness, distances)].into(), ..Gain::default() },
            detectors: vec![],
            not_identifiable: vec![],
            considered: vec![],
            notes: vec![],
        }
    }

    #[test]
    fn a_size_that_is_not_known_well_leaves_a_part_of_the_difference() {
        let left = |parameters: &[(Quantity, f64, [f64; 2])]| {
            let of = |(q, estimate, ci95): &(Quantity, f64, [f64; 2])| {
                let parameter = Parameter { estimate: *estimate, unit: Unit::Metre, ci95: *ci95 };
                (ParameterId::Of(*q), parameter)
            };
            left_by_errors(&parameters.iter().map(of).collect())
        };
        let bias = (Quantity::OffsetM, -0.02, [-0.04, -0.01]);
        assert!((left(&[bias]) - 0.25).abs() < 1e-9);
        assert!((left(&[bias, (Quantity::Scale, 0.01, [0.009, 0.011])]) - 1.0 / 121.0).abs() < 1e-9);
        assert_eq!(left(&[(Quantity::MaxM, 40.0, [10.0, 80.0])]), 0.0, "no amplitude");
    }

    #[test]
    fn what_makes_a_difference_where_none_was_is_taken_back() {
        let status_after = |distances: [f64; 3]| {
            let mut diagnosis = noise_with(distances);
            let taken = take_back_differences(&mut diagnosis, 1e-4);
            assert_eq!(taken, diagnosis.findings[0].effects.is_empty());
            diagnosis.findings[0].status
        };
        assert_eq!(status_after([1e-5, 3e-3, 0.0]), Status::NotIdentifiable);
        assert_eq!(status_after([4e-3, 1e-3, 0.0]), Status::Named, "it is nearer than before");
        assert_eq!(status_after([1e-5, 5e-5, 0.0]), Status::Named, "neither before nor after");
        assert_eq!(status_after([1e-5, 3e-3, 3e-3]), Status::Named, "two draws differ as much");
    }
}
