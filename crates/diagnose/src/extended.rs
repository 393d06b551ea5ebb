//! The file `extended.toml`: the effects of all findings as a list for the simulator, with what was found and its
//! intervals as comments. What the simulator has no effect for is a comment alone.

use crate::diagnosis::{Diagnosis, Finding, Status};
use crate::effects::cause_of;
use sensor::{Effect, EffectList};
use std::collections::BTreeSet;
use std::fmt::Write;

/// Order in which light meets the effects: the world, the shots, the returns, the numbers, the labels.
const ORDER: [&str; 23] = [
    "missing_object",
    "wrong_shape",
    "pitch_roll",
    "sensor_extrinsics",
    "beam_elevation_offset",
    "angular_jitter",
    "rolling_shutter",
    "mixed_pixels",
    "ego_occlusion",
    "material_dropout",
    "signal_dropout",
    "incidence_dropout",
    "range_dropout",
    "random_dropout",
    "outliers",
    "range_bias",
    "beam_range_offset",
    "range_noise",
    "signal_noise",
    "range_cut",
    "quantisation",
    "label_offset",
    "time_offset",
];

/// The text of `extended.toml`, for a diagnosis whose findings carry their effects.
pub fn extended_toml(diagnosis: &Diagnosis) -> String {
    let mut text = String::from(
        "# What the diagnosis adds to the simulation's sensor model: a list of effects.\n\
         # Intervals (95 %) stand above each effect.\n",
    );
    let place = |f: &Finding| {
        let cause = if f.status == Status::Named { cause_of(f) } else { "" };
        ORDER.iter().position(|o| *o == cause).unwrap_or(ORDER.len())
    };
    let mut findings: Vec<&Finding> = diagnosis.findings.iter().collect();
    findings.sort_by_key(|f| place(f));
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
    let list = EffectList { effects: vec![effect.clone()] };
    toml::to_string(&list).expect("an effect is plain data")
}

/// What stands above the effects of a finding.
fn comments(f: &Finding) -> Vec<String> {
    let mut lines: Vec<String> = f.says.lines().map(str::to_owned).collect();
    if f.status == Status::Ambiguous {
        let names = f.candidates.clone().unwrap_or_default().join(" and ");
        lines.push(format!("These data do not tell {names} apart for sure; the first of them stands here."));
    }
    if f.effects.is_empty() {
        lines.push(why_none(f));
        return lines;
    }
    let of_rows = |name: &str| name.contains('/');
    for (name, p) in f.parameters.iter().filter(|(name, _)| *name != "sensor" && !of_rows(name)) {
        let [low, high] = p.ci95.map(short);
        lines.push(format!("{name}: {low} to {high}"));
    }
    let sensors: BTreeSet<&str> = f.parameters.keys().filter_map(|n| Some(n.split_once('/')?.0)).collect();
    if sensors.len() > 1 {
        lines.push("One table serves for all sensors: the mean over them.".into());
    }
    if f.status == Status::Unexplained && f.covariate != "direction" {
        let errors = || f.curve.points.iter().map(|p| p.error);
        let [low, high] = [errors().fold(f64::MAX, f64::min), errors().fold(0.0, f64::max)].map(short);
        lines.push(format!("standard errors of what was measured along the curve: {low} to {high}"));
    }
    lines
}

/// Why no effect stands for a finding.
fn why_none(f: &Finding) -> String {
    let negative = ["std_m", "std_deg", "share"].into_iter().find_map(|name| {
        let p = f.parameters.get(name)?;
        (p.estimate < 0.0).then_some((name, p.estimate))
    });
    match (cause_of(f), negative) {
        ("range_noise" | "angular_jitter" | "random_dropout" | "material_dropout", Some((name, by))) => {
            let by = short(by);
            format!("The simulation has more of it than the measurement: take it out there ({name} by {by}).")
        }
        ("mixed_pixels", _) => "beam_divergence: how wide the beams are these data do not tell.".into(),
        ("", _) => "There is no table of it for any sensor of the rig.".into(),
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
    use crate::diagnosis::{Curve, CurvePoint, FindingGain, Gain, Parameter, SCHEMA, Verdict};
    use crate::effects::fill_effects;
    use sensor::Rig;
    use sensor::effects::{BeamAngleError, EgoAttitude, RangeBias, SignalDropout};
    use std::collections::BTreeMap;

    fn finding(cause: &str, parameters: &[(&str, f64)]) -> Finding {
        let parameter = |v: f64| Parameter { estimate: v, unit: "m".into(), ci95: [0.9 * v, 1.1 * v] };
        Finding {
            status: Status::Named,
            cause: Some(cause.into()),
            candidates: None,
            family: "range_error".into(),
            parameters: parameters.iter().map(|(n, v)| ((*n).to_owned(), parameter(*v))).collect::<BTreeMap<_, _>>(),
            confidence: 1.0,
            channel: "roughness".into(),
            covariate: "none".into(),
            gain: FindingGain::default(),
            says: format!("says {cause}"),
            separate_by: None,
            curve: Curve::default(),
            effects: vec![],
        }
    }

    fn diagnosis(mut findings: Vec<Finding>) -> Diagnosis {
        fill_effects(&mut findings, &Rig::single(), &[vec![-5.0, -4.0]]);
        Diagnosis {
            schema: SCHEMA.into(),
            verdict: Verdict::Explained,
            frames: Default::default(),
            findings,
            minimum_detectable: Default::default(),
            gain: Gain {
                metric: "nats_per_ray".into(),
                before: 1.0,
                after: 0.1,
                floor: 0.0,
                closed: Some(0.9),
                ci95: None,
                channels: BTreeMap::new(),
            },
            detectors: vec![],
            considered: vec![],
            notes: vec![],
        }
    }

    #[test]
    fn effects_stand_in_the_order_in_which_light_meets_them() {
        let diagnosis = diagnosis(vec![
            finding("label_offset", &[("forward_m", 0.3)]),
            finding("range_noise", &[("std_m", 0.02), ("per_m", 0.0)]),
            finding("random_dropout", &[("share", 0.2)]),
            finding("random_dropout", &[("share", -0.2)]),
            finding("wrong_shape", &[("longer_m", 0.2)]),
        ]);
        let text = extended_toml(&diagnosis);
        let table: toml::Table = toml::from_str(&text).unwrap();
        let kinds: Vec<&str> =
            table["effect"].as_array().unwrap().iter().map(|e| e["kind"].as_str().unwrap()).collect();
        assert_eq!(kinds, ["random_dropout", "range_noise", "label_offset"]);
        assert!(
            text.contains("# share: 0.18 to 0.22\n[[effect]]\nkind = \"random_dropout\"\nshare = 0.2\n")
                && text.contains("take it out there"),
            "{text}"
        );
        assert!(text.contains("mend its world"), "{text}");
    }

    #[test]
    fn the_simulator_reads_every_cause() {
        let unexplained = |channel: &str, covariate: &str, at: &[f64]| Finding {
            status: Status::Unexplained,
            cause: None,
            channel: channel.into(),
            covariate: covariate.into(),
            curve: Curve {
                points: at
                    .iter()
                    .map(|x| CurvePoint { x: *x, measured: 0.9, before: 1.0, after: 0.9, error: 0.1 })
                    .collect(),
                ..Curve::default()
            },
            ..finding("", &[("simulated_std_m", 0.01)])
        };
        let findings = vec![
            finding("range_noise", &[("std_m", 0.02), ("per_m", 1e-4)]),
            finding("range_noise", &[("std_m", 0.02), ("per_m", 0.0)]),
            finding("signal_noise", &[("std_m", 0.02), ("exponent", 0.5)]),
            finding("range_bias", &[("offset_m", -0.02), ("scale", 1e-3)]),
            finding("beam_range_offset", &[("std_m", 0.02), ("lidar/0", 0.01), ("lidar/1", -0.01)]),
            finding("beam_elevation_offset", &[("std_deg", 0.1)]),
            finding("quantisation", &[("step_m", 0.02)]),
            finding("angular_jitter", &[("std_deg", 0.05)]),
            finding("random_dropout", &[("share", 0.2)]),
            finding("signal_dropout", &[("threshold", 1.0), ("steepness", 3.0)]),
            finding("incidence_dropout", &[("cos_half", 0.1), ("steepness", 3.0)]),
            finding("range_dropout", &[("half_at_m", 50.0), ("steepness", 6.0)]),
            finding("material_dropout", &[("share", 0.5)]),
            finding("range_cut", &[("max_m", 80.0)]),
            finding(
                "ego_occlusion",
                &[
                    ("azimuth_from_deg", -10.0),
                    ("azimuth_to_deg", 10.0),
                    ("elevation_from_deg", -4.0),
                    ("elevation_to_deg", 1.0),
                ],
            ),
            finding("sensor_extrinsics", &[("sensor", 0.0), ("yaw_deg", 0.2)]),
            finding("pitch_roll", &[("pitch_deg", 0.2)]),
            finding("rolling_shutter", &[("scan_s", 0.1)]),
            finding("outliers", &[("rate", 0.01), ("reach_m", 90.0)]),
            finding("mixed_pixels", &[("share", 0.01), ("divergence_rad", 0.004)]),
            finding("label_offset", &[("forward_m", 0.2)]),
            finding("time_offset", &[("offset_s", 0.02)]),
            finding("wrong_shape", &[("longer_m", 0.2)]),
            finding("missing_object", &[("share", 0.02)]),
            unexplained("hits", "azimuth", &[-30.0, 10.0, 50.0]),
            unexplained("roughness", "row", &[0.0, 1.0]),
            unexplained("residuals", "azimuth", &[-30.0, 10.0]),
            Finding {
                parameters: finding(
                    "",
                    &[
                        ("sensor", 0.0),
                        ("azimuth_deg", -20.0),
                        ("elevation_deg", -4.0),
                        ("radius_deg", 5.0),
                        ("share", 0.4),
                    ],
                )
                .parameters,
                ..unexplained("hits", "direction", &[-20.0])
            },
        ];
        for f in findings {
            let what = f.cause.clone().unwrap_or_else(|| f.channel.clone());
            let diagnosis = diagnosis(vec![f]);
            let text = extended_toml(&diagnosis);
            let read = EffectList::parse(&text, std::path::Path::new("extended.toml"));
            let effects = read.unwrap_or_else(|e| panic!("{what}: {e}\n{text}")).effects;
            assert_eq!(effects, diagnosis.findings[0].effects, "{what}: {text}");
            let of_the_world = matches!(what.as_str(), "wrong_shape" | "missing_object");
            assert_eq!(effects.is_empty(), of_the_world, "{what}: {text}");
        }
    }

    #[test]
    fn what_a_finding_does_not_have_changes_nothing() {
        let effect = |cause: &str, parameters: &[(&str, f64)]| {
            let diagnosis = diagnosis(vec![finding(cause, parameters)]);
            diagnosis.findings[0].effects.clone()
        };
        assert_eq!(
            effect("range_bias", &[("scale", 1e-3)]),
            [Effect::RangeBias(RangeBias { offset_m: 0.0, scale: 1e-3 })]
        );
        assert_eq!(
            effect("beam_elevation_offset", &[("mean_deg", 0.2)]),
            [Effect::BeamAngleError(BeamAngleError {
                elevation_deg: 0.2,
                elevation_std_deg: 0.0,
                azimuth_std_deg: 0.0
            })]
        );
        assert_eq!(
            effect("signal_dropout", &[("threshold", 1.0), ("steepness", 3.0)]),
            [Effect::SignalDropout(SignalDropout {
                most: 1.0,
                threshold: 1.0,
                steepness: 3.0,
                attenuation_per_m: 0.0
            })]
        );
        let [Effect::EgoAttitude(attitude)] = &effect("pitch_roll", &[("roll_deg", 0.2)])[..] else { panic!() };
        let still = EgoAttitude { roll_deg: 0.2, pitch_deg: 0.0, roll_std_deg: 0.0, pitch_std_deg: 0.0, ..*attitude };
        assert_eq!((attitude, attitude.heave_std_m, attitude.pitch_at_70mps_deg), (&still, 0.0, 0.0));
    }

    #[test]
    fn effects_do_not_stand_in_the_json() {
        let diagnosis = diagnosis(vec![finding("range_noise", &[("std_m", 0.02)])]);
        assert_eq!(diagnosis.findings[0].effects.len(), 1);
        let json = serde_json::to_value(&diagnosis).unwrap();
        assert!(json["findings"][0].get("effects").is_none());
    }
}
