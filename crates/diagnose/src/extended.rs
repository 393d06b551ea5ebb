//! The file `extended.toml`: the effects of all findings as a list for the simulator, with what was found and its
//! intervals as comments. What the simulator has no effect for is a comment alone.

use crate::catalogue::{Cause, Covariate, ParameterId, Quantity};
use crate::diagnosis::{Diagnosis, Finding, Status};
use crate::effects::cause_of;
use data::Dataset;
use sensor::effects::MadeFrom;
use sensor::{Effect, EffectList, Rig};
use std::fmt::Write;

/// What a list of effects is made from.
pub(crate) fn made_from(measured: &Dataset, simulated: &Dataset, rig: &Rig) -> MadeFrom {
    MadeFrom {
        measured: measured.config.root.clone(),
        simulated: simulated.config.root.clone(),
        sensors: rig.sensors.iter().map(|s| s.name.clone()).collect(),
    }
}

/// The text of `extended.toml`, for a diagnosis whose findings carry their effects.
pub fn extended_toml(diagnosis: &Diagnosis, made_from: Option<&MadeFrom>) -> String {
    let mut text = String::from(
        "# What the diagnosis adds to the simulation's sensor model: a list of effects.\n\
         # Intervals (95 %) stand above each effect.\n",
    );
    if let Some(made_from) = made_from {
        let head = EffectList { made_from: Some(made_from.clone()), ..EffectList::default() };
        let table = toml::to_string(&head).expect("a list is plain data");
        text.push_str("\n# The data that it was made from, so that it is not applied to others.\n");
        text.push_str(table.strip_suffix("effect = []\n").unwrap_or(&table).trim_start_matches("effect = []\n\n"));
    }
    let mut findings: Vec<&Finding> = diagnosis.findings.iter().collect();
    findings.sort_by_key(|f| cause_of(f).place());
    if findings.is_empty() {
        text.push_str("# Nothing was found: the list is empty.\n");
    }
    for f in findings {
        text.push('\n');
        for line in comments(f) {
            let _ = writeln!(text, "# {line}");
        }
        for effect in &f.effects {
            text.push_str(&one_table(effect));
        }
    }
    text
}

/// An effect as the simulator reads it.
fn one_table(effect: &Effect) -> String {
    let list = EffectList::of(vec![effect.clone()]);
    toml::to_string(&list).expect("an effect is plain data")
}

/// What stands above the effects of a finding.
fn comments(f: &Finding) -> Vec<String> {
    let mut lines: Vec<String> = f.says.lines().map(str::to_owned).collect();
    if f.status == Status::Ambiguous {
        let names: Vec<&str> = f.candidates.iter().flatten().map(|c| c.name()).collect();
        let names = names.join(" and ");
        lines.push(format!("These data do not tell {names} apart for sure; the first of them stands here."));
    }
    if f.status == Status::NotIdentifiable {
        lines.extend(f.separate_by.iter().map(|by| format!("What can tell: {by}")));
        return lines;
    }
    if f.effects.is_empty() {
        lines.push(why_none(f));
        return lines;
    }
    for (id, p) in &f.parameters {
        let [low, high] = p.ci95.map(short);
        match id {
            ParameterId::Of(Quantity::Sensor) | ParameterId::Row { .. } => {}
            ParameterId::Of(quantity) => lines.push(format!("{quantity}: {low} to {high}")),
        }
    }
    if f.status == Status::Unexplained && f.covariate != Covariate::Direction {
        let errors = || f.curve.points.iter().map(|p| p.error);
        let [low, high] = [errors().fold(f64::MAX, f64::min), errors().fold(0.0, f64::max)].map(short);
        lines.push(format!("standard errors of what was measured along the curve: {low} to {high}"));
    }
    lines
}

/// What has to be changed in the simulation for a finding, in a sentence.
pub fn what_to_change(finding: &Finding) -> String {
    let mut kinds: Vec<&str> = finding.effects.iter().map(sensor::Effect::kind).collect();
    kinds.dedup();
    match kinds.is_empty() {
        true => why_none(finding),
        false => format!("Apply {} of extended.toml.", kinds.join(", ")),
    }
}

/// Why no effect stands for a finding.
pub(crate) fn why_none(f: &Finding) -> String {
    if f.status == Status::NotIdentifiable {
        return "Nothing: this pair cannot tell how large it is.".into();
    }
    let negative = [Quantity::StdM, Quantity::StdDeg, Quantity::Share].into_iter().find_map(|quantity| {
        let p = f.parameter(quantity)?;
        (p.estimate < 0.0).then_some((quantity, p.estimate))
    });
    match (cause_of(f), negative) {
        (
            Cause::RangeNoise | Cause::AngularJitter | Cause::RandomDropout | Cause::MaterialDropout,
            Some((quantity, by)),
        ) => {
            let by = short(by);
            format!("The simulation has more of it than the measurement: take it out there ({quantity} by {by}).")
        }
        (Cause::Blooming | Cause::BrightTargetDropout, _) => format!(
            "{}: it needs the light that targets return, which finished clouds do not hold: put it into the list of the \
             simulator, with returned_above below that of your signs and plates.",
            cause_of(f)
        ),
        (Cause::Ghosts, _) => {
            "ghosts: give the materials that mirror a specular lobe, and the shots a probability.".into()
        }
        (Cause::Unexplained, _) if f.covariate == Covariate::ScanPhase => {
            "The simulator has no effect that does this: mount_vibration tilts whole scans.".into()
        }
        (Cause::Unexplained, _) => "There is no table of it for any sensor of the rig.".into(),
        (other, _) => {
            format!("The simulator has no effect that does this by itself ({other}): mend its world.")
        }
    }
}

fn short(v: f64) -> String {
    format!("{}", (v * 1e5).round() / 1e5)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::catalogue::{Channel, Unit};
    use crate::curve::{Curve, CurvePoint};
    use crate::diagnosis::{FindingGain, Gain, Parameter, SCHEMA, Verdict};
    use crate::effects::{RowsOf, fill_effects};
    use sensor::Rig;
    use sensor::effects::{BeamAngleError, EgoAttitude, RandomDropout, RangeBias};

    fn finding(cause: Cause, parameters: &[(Quantity, f64)]) -> Finding {
        let parameter =
            |q: Quantity, v: f64| (q.into(), Parameter { estimate: v, unit: q.unit(), ci95: [0.9 * v, 1.1 * v] });
        Finding {
            status: Status::Named,
            cause: Some(cause),
            candidates: None,
            family: cause.family(),
            parameters: parameters.iter().map(|(q, v)| parameter(*q, *v)).collect(),
            confidence: 1.0,
            channel: Channel::Roughness,
            covariate: Covariate::None,
            gain: FindingGain::default(),
            predicted: None,
            reached: None,
            says: format!("says {cause}"),
            separate_by: None,
            curve: Curve::default(),
            effects: vec![],
        }
    }

    fn with_rows(mut finding: Finding, offsets: [f64; 2]) -> Finding {
        for (row, v) in offsets.into_iter().enumerate() {
            let id = ParameterId::Row { sensor: "lidar".into(), row };
            finding.parameters.insert(id, Parameter { estimate: v, unit: Unit::Metre, ci95: [v - 0.001, v + 0.001] });
        }
        finding
    }

    fn diagnosis(mut findings: Vec<Finding>) -> Diagnosis {
        fill_effects(&mut findings, &Rig::single(), &[RowsOf { deg: vec![-5.0, -4.0], heights_m: vec![] }]);
        Diagnosis {
            schema: SCHEMA.into(),
            build: data::build_id().into(),
            verdict: Verdict::Explained,
            frames: Default::default(),
            findings,
            minimum_detectable: Default::default(),
            gain: Gain::default(),
            detectors: vec![],
            not_identifiable: vec![],
            considered: vec![],
            notes: vec![],
        }
    }

    #[test]
    fn effects_stand_in_the_order_in_which_light_meets_them() {
        let diagnosis = diagnosis(vec![
            finding(Cause::LabelOffset, &[(Quantity::ForwardM, 0.3)]),
            finding(Cause::RangeNoise, &[(Quantity::StdM, 0.02), (Quantity::PerM, 0.0)]),
            Finding {
                effects: vec![Effect::RandomDropout(RandomDropout { share: 0.2 })],
                ..finding(Cause::RandomDropout, &[(Quantity::Share, 0.2)])
            },
            finding(Cause::RandomDropout, &[(Quantity::Share, -0.2)]),
            finding(Cause::Quantisation, &[(Quantity::StepM, 0.004)]),
            Finding {
                status: Status::Ambiguous,
                cause: None,
                candidates: Some(vec![Cause::RangeBias, Cause::RollingShutter]),
                ..finding(Cause::RangeBias, &[(Quantity::OffsetM, 0.1)])
            },
            Finding {
                status: Status::Unexplained,
                cause: None,
                covariate: Covariate::Row,
                curve: Curve {
                    points: vec![CurvePoint {
                        sensor: 0,
                        x: 0.0,
                        measured: 0.02,
                        before: 0.01,
                        after: 0.02,
                        error: 0.001,
                    }],
                    ..Curve::default()
                },
                ..finding(Cause::Unexplained, &[(Quantity::SimulatedStdM, 0.01)])
            },
            finding(Cause::WrongShape, &[(Quantity::LongerM, 0.2)]),
        ]);
        let text = extended_toml(&diagnosis, None);
        let table: toml::Table = toml::from_str(&text).unwrap();
        let kinds: Vec<&str> =
            table["effect"].as_array().unwrap().iter().map(|e| e["kind"].as_str().unwrap()).collect();
        // A table without a name and the first candidate of an ambiguous finding stand before rounding: a sensor rounds
        // what it measured.
        assert_eq!(
            kinds,
            ["random_dropout", "range_bias", "range_noise", "empirical", "range_quantisation", "label_offset"]
        );
        assert!(
            text.contains("# share: 0.18 to 0.22\n[[effect]]\nkind = \"random_dropout\"\nshare = 0.2\n")
                && text.contains("take it out there"),
            "{text}"
        );
        assert!(text.contains("mend its world"), "{text}");
    }

    /// A difference without a cause at some places.
    fn unexplained(channel: Channel, covariate: Covariate, at: &[f64]) -> Finding {
        Finding {
            status: Status::Unexplained,
            cause: None,
            channel,
            covariate,
            curve: Curve {
                points: at
                    .iter()
                    .map(|x| CurvePoint { sensor: 0, x: *x, measured: 0.9, before: 1.0, after: 0.9, error: 0.1 })
                    .collect(),
                ..Curve::default()
            },
            ..finding(Cause::Unexplained, &[(Quantity::SimulatedStdM, 0.01)])
        }
    }

    /// Losses in a spot of directions, without a name.
    fn unexplained_spot() -> Finding {
        let parameters = [
            (Quantity::Sensor, 0.0),
            (Quantity::AzimuthDeg, -20.0),
            (Quantity::ElevationDeg, -4.0),
            (Quantity::RadiusDeg, 5.0),
            (Quantity::Aspect, 1.5),
            (Quantity::Sharpness, 3.0),
            (Quantity::Share, 0.4),
        ];
        Finding {
            parameters: finding(Cause::Unexplained, &parameters).parameters,
            ..unexplained(Channel::Hits, Covariate::Direction, &[-20.0])
        }
    }

    #[test]
    fn the_simulator_reads_every_cause() {
        let findings = vec![
            finding(Cause::RangeNoise, &[(Quantity::StdM, 0.02), (Quantity::PerM, 1e-4)]),
            finding(Cause::RangeNoise, &[(Quantity::StdM, 0.02), (Quantity::PerM, 0.0)]),
            finding(Cause::SignalNoise, &[(Quantity::StdM, 0.02), (Quantity::Exponent, 0.5)]),
            finding(Cause::RangeBias, &[(Quantity::OffsetM, -0.02), (Quantity::Scale, 1e-3)]),
            with_rows(finding(Cause::BeamRangeOffset, &[(Quantity::StdM, 0.02)]), [0.01, -0.01]),
            finding(Cause::BeamElevationOffset, &[(Quantity::StdDeg, 0.1)]),
            finding(Cause::Quantisation, &[(Quantity::StepM, 0.02)]),
            finding(Cause::AngularJitter, &[(Quantity::StdDeg, 0.05)]),
            finding(Cause::RangeCut, &[(Quantity::MaxM, 80.0)]),
            finding(Cause::SensorExtrinsics, &[(Quantity::Sensor, 0.0), (Quantity::YawDeg, 0.2)]),
            finding(Cause::PitchRoll, &[(Quantity::PitchDeg, 0.2)]),
            finding(Cause::RollingShutter, &[(Quantity::ScanS, 0.1)]),
            finding(Cause::MixedPixels, &[(Quantity::DivergenceRad, 0.004), (Quantity::PulseM, 1.5)]),
            finding(Cause::LabelOffset, &[(Quantity::ForwardM, 0.2)]),
            finding(Cause::TimeOffset, &[(Quantity::OffsetS, 0.02)]),
            finding(Cause::WrongShape, &[(Quantity::LongerM, 0.2)]),
            finding(Cause::MissingObject, &[(Quantity::Share, 0.02)]),
            unexplained(Channel::Hits, Covariate::Azimuth, &[-30.0, 10.0, 50.0]),
            unexplained(Channel::Roughness, Covariate::Row, &[0.0, 1.0]),
            unexplained(Channel::Residuals, Covariate::Azimuth, &[-30.0, 10.0]),
            unexplained_spot(),
        ];
        for f in findings {
            let what = f.cause.map_or(f.channel.name(), Cause::name);
            let diagnosis = diagnosis(vec![f]);
            let text = extended_toml(&diagnosis, None);
            let read = EffectList::parse(&text, std::path::Path::new("extended.toml"));
            let effects = read.unwrap_or_else(|e| panic!("{what}: {e}\n{text}")).effects;
            assert_eq!(effects, diagnosis.findings[0].effects, "{what}: {text}");
            let of_the_world = matches!(what, "wrong_shape" | "missing_object");
            assert_eq!(effects.is_empty(), of_the_world, "{what}: {text}");
        }
    }

    #[test]
    fn what_a_finding_does_not_have_changes_nothing() {
        let effect = |cause: Cause, parameters: &[(Quantity, f64)]| {
            let diagnosis = diagnosis(vec![finding(cause, parameters)]);
            diagnosis.findings[0].effects.clone()
        };
        assert_eq!(
            effect(Cause::RangeBias, &[(Quantity::Scale, 1e-3)]),
            [Effect::RangeBias(RangeBias { offset_m: 0.0, scale: 1e-3 })]
        );
        assert_eq!(
            effect(Cause::BeamElevationOffset, &[(Quantity::MeanDeg, 0.2)]),
            [Effect::BeamAngleError(BeamAngleError { elevation_deg: 0.2, ..BeamAngleError::default() })]
        );
        let [Effect::EgoAttitude(attitude)] = &effect(Cause::PitchRoll, &[(Quantity::RollDeg, 0.2)])[..] else {
            panic!()
        };
        let still = EgoAttitude { roll_deg: 0.2, pitch_deg: 0.0, roll_std_deg: 0.0, pitch_std_deg: 0.0, ..*attitude };
        assert_eq!((attitude, attitude.heave_std_m, attitude.pitch_at_70mps_deg), (&still, 0.0, 0.0));
    }

    #[test]
    fn effects_do_not_stand_in_the_json() {
        let diagnosis = diagnosis(vec![finding(Cause::RangeNoise, &[(Quantity::StdM, 0.02)])]);
        assert_eq!(diagnosis.findings[0].effects.len(), 1);
        let json = serde_json::to_value(&diagnosis).unwrap();
        assert!(json["findings"][0].get("effects").is_none());
    }
}
