//! The file `extended.toml`: what was found as a list of effects for the simulator, with intervals as comments. What the simulator has no
//! effect for is listed in comments; what has no name is written as tables.

use crate::catalogue::{Cause, Channel, Covariate, ParameterId, Quantity};
use crate::diagnosis::{Diagnosis, Finding, Status};
use crate::pairing::GAP_M;
use crate::rig::SensorRig;
use std::fmt::Write;

/// The text of `extended.toml`. `rows_deg` holds the elevations of the rows of every sensor.
pub fn extended_toml(diagnosis: &Diagnosis, rig: &SensorRig, rows_deg: &[Vec<f64>]) -> String {
    let mut text = String::from(
        "# What the diagnosis adds to the simulation's sensor model: a list of effects. Intervals (95 %) stand behind the values.\n",
    );
    let place = |f: &Finding| f.cause.map_or(u16::MAX, Cause::place);
    let mut findings: Vec<&Finding> = diagnosis.findings.iter().collect();
    findings.sort_by_key(|f| place(f));
    if findings.is_empty() {
        text.push_str("# Nothing was found: the list is empty.\n");
    }
    for f in findings {
        let _ = writeln!(text, "\n# {}", f.says);
        match f.status {
            Status::Named => text.push_str(&named(f, rig)),
            Status::Ambiguous => {
                let names = f.candidates.clone().unwrap_or_default();
                let _ = writeln!(
                    text,
                    "# These data do not tell {} apart for sure; the first of them stands here.",
                    names.iter().map(|c| c.name()).collect::<Vec<_>>().join(" and ")
                );
                let first = Finding { cause: names.first().copied(), ..f.clone() };
                text.push_str(&named(&first, rig));
            }
            Status::Unexplained => text.push_str(&empirical(f, rig, rows_deg)),
        }
    }
    text
}

/// Share that a law loses where nothing of it is felt.
fn lost_anyway(f: &Finding) -> f64 {
    f.parameter(Quantity::Most).map_or(0.0, |most| (1.0 - most.estimate).max(0.0))
}

/// One effect as the simulator reads it.
fn named(f: &Finding, rig: &SensorRig) -> String {
    let value = |quantity: Quantity| f.parameter(quantity).map_or(0.0, |p| p.estimate);
    let key = |key: &str, quantity: Quantity| -> String {
        f.parameter(quantity).map_or_else(String::new, |p| {
            let [low, high] = p.ci95.map(short);
            format!("{key} = {} # {low} to {high}\n", toml_number(p.estimate))
        })
    };
    let with = |kind: &str, lines: String| format!("[[effect]]\nkind = \"{kind}\"\n{lines}");
    let Some(cause) = f.cause else { return String::new() };
    match cause {
        Cause::RangeNoise if value(Quantity::PerM) > 0.0 => {
            with("range_noise_by_range", key("base_m", Quantity::StdM) + &key("per_m", Quantity::PerM))
        }
        Cause::RangeNoise => positive(f, Quantity::StdM, with("range_noise", key("std_m", Quantity::StdM))),
        Cause::SignalNoise => with(
            "range_noise_by_signal",
            key("std_m", Quantity::StdM)
                + &key("exponent", Quantity::Exponent)
                + &format!("signal = {:?}\n", crate::inference::noise::USUAL_SIGNAL),
        ),
        Cause::IncidenceNoise => with(
            "range_noise_by_incidence",
            format!("divergence_rad = {}\nsamples = 1.0\n", toml_number(2.0 * value(Quantity::AngleRad))),
        ),
        Cause::RangeBias => with("range_bias", key("offset_m", Quantity::OffsetM) + &key("scale", Quantity::Scale)),
        Cause::BeamRangeOffset => with("beam_range_offset", row_table(f, rig)),
        Cause::BeamElevationOffset => {
            let none = if f.parameter(Quantity::StdDeg).is_some() { "" } else { "elevation_std_deg = 0.0\n" };
            let lines = key("elevation_deg", Quantity::MeanDeg) + &key("elevation_std_deg", Quantity::StdDeg) + none;
            with("beam_angle_error", lines + "azimuth_std_deg = 0.0\n")
        }
        Cause::Quantisation => with("range_quantisation", key("step_m", Quantity::StepM)),
        Cause::AngularJitter => positive(
            f,
            Quantity::StdDeg,
            with(
                "angular_jitter",
                key("azimuth_std_deg", Quantity::StdDeg) + &key("elevation_std_deg", Quantity::StdDeg),
            ),
        ),
        Cause::RandomDropout => positive(f, Quantity::Share, with("random_dropout", key("share", Quantity::Share))),
        Cause::SignalDropout => with(
            "signal_dropout",
            key("threshold", Quantity::Threshold)
                + &key("steepness", Quantity::Steepness)
                + &key("most", Quantity::Most),
        ),
        Cause::IncidenceDropout => {
            // The simulator's step is one over the cosine, the finding's one over its logarithm: as steep at one half.
            let steepness = toml_number(value(Quantity::Steepness) / value(Quantity::CosHalf).max(1e-3));
            let mut text =
                with("incidence_dropout", key("cos_half", Quantity::CosHalf) + &format!("steepness = {steepness}\n"));
            if lost_anyway(f) > 0.0 {
                text += &with("random_dropout", format!("share = {}\n", toml_number(lost_anyway(f))));
            }
            text
        }
        Cause::RangeDropout => {
            let (half, steepness) = (value(Quantity::HalfAtM).max(1e-3), value(Quantity::Steepness));
            let ranges: Vec<f64> = (0..=24).map(|i| 5.0 * f64::from(i)).collect();
            let most = 1.0 - lost_anyway(f);
            let kept = |r: f64| if r > 0.0 { most / (1.0 + (r / half).powf(steepness)) } else { most };
            let lost = ranges.iter().map(|r| 1.0 - kept(*r));
            let lost: Vec<String> = lost.map(|v| format!("{v:.4}")).collect();
            let ranges: Vec<String> = ranges.iter().map(|r| format!("{r:.1}")).collect();
            with("range_dropout", format!("range_m = [{}]\nshare = [{}]\n", ranges.join(", "), lost.join(", ")))
        }
        Cause::MaterialDropout => {
            let materials = match f.covariate {
                Covariate::SurfaceGround => "\"asphalt\"",
                Covariate::SurfaceStanding => "\"concrete\"",
                Covariate::SurfaceObjectCorner => "\"rubber\"",
                _ => "\"paint\"",
            };
            positive(
                f,
                Quantity::Share,
                with("material_dropout", format!("materials = [{materials}]\n") + &key("share", Quantity::Share)),
            )
        }
        Cause::RangeCut => with("range_limits", key("max_m", Quantity::MaxM)),
        Cause::EgoOcclusion => blocked_box(f, rig),
        Cause::SensorExtrinsics => {
            let sensor = &rig.sensors[(value(Quantity::Sensor) as usize).min(rig.sensors.len() - 1)].name;
            let three = |names: [Quantity; 3]| names.map(|n| toml_number(value(n))).join(", ");
            let intervals: Vec<String> = f
                .parameters
                .iter()
                .filter(|(n, _)| **n != ParameterId::Of(Quantity::Sensor))
                .map(|(n, p)| format!("# {n}: {} to {}\n", short(p.ci95[0]), short(p.ci95[1])))
                .collect();
            with(
                "sensor_pose_error",
                format!(
                    "sensor = \"{sensor}\"\ntranslation_m = [{}]\nrotation_deg = [{}]\n{}",
                    three([Quantity::ForwardM, Quantity::LeftM, Quantity::UpM]),
                    three([Quantity::RollDeg, Quantity::PitchDeg, Quantity::YawDeg]),
                    intervals.concat()
                ),
            )
        }
        Cause::PitchRoll => {
            let steady = |key: &str, quantity: Quantity| {
                if f.parameter(quantity).is_some() { String::new() } else { format!("{key} = 0.0\n") }
            };
            let lines = key("roll_deg", Quantity::RollDeg)
                + &key("pitch_deg", Quantity::PitchDeg)
                + &steady("roll_deg", Quantity::RollDeg)
                + &steady("pitch_deg", Quantity::PitchDeg)
                + "roll_std_deg = 0.0\npitch_std_deg = 0.0\n";
            with("ego_attitude", lines)
        }
        Cause::RollingShutter => with("rolling_shutter", "deskewed = false\n".into()),
        Cause::Outliers => with("false_alarms", key("rate", Quantity::Rate) + &key("reach_m", Quantity::ReachM)),
        // Ranges that mix over such jumps come from pulses, or modulations, as long as that.
        Cause::MixedPixels if f.parameter(Quantity::DivergenceRad).is_none() => {
            "# beam_divergence: how wide the beams are these data do not tell.\n".into()
        }
        Cause::MixedPixels => with(
            "beam_divergence",
            key("divergence_rad", Quantity::DivergenceRad) + &format!("pulse_m = {:?}\n", GAP_M[1]),
        ),
        Cause::LabelOffset => with(
            "label_offset",
            key("forward_m", Quantity::ForwardM) + &key("left_m", Quantity::LeftM) + &key("up_m", Quantity::UpM),
        ),
        Cause::TimeOffset => {
            let clock = if f.covariate == Covariate::SeenVelocity { "cloud" } else { "cars" };
            with("label_time_offset", key("offset_s", Quantity::OffsetS) + &format!("clock = \"{clock}\"\n"))
        }
        other => format!("# The simulator has no effect that does this by itself ({other}): mend its world.\n"),
    }
}

/// A simulation that has too much of something is mended by taking it out, not by an effect.
fn positive(f: &Finding, quantity: Quantity, text: String) -> String {
    match f.parameter(quantity).filter(|p| p.estimate < 0.0) {
        Some(p) => format!(
            "# The simulation has more of it than the measurement: take it out there ({quantity} by {}).\n",
            short(p.estimate)
        ),
        None => text,
    }
}

/// Offsets of rows from the top, the mean of all sensors.
fn row_table(f: &Finding, rig: &SensorRig) -> String {
    let mut rows: Vec<Vec<f64>> = Vec::new();
    for sensor in &rig.sensors {
        for (name, p) in &f.parameters {
            let row = match name {
                ParameterId::Row { sensor: of, row } if *of == sensor.name => *row,
                _ => continue,
            };
            if rows.len() <= row {
                rows.resize(row + 1, Vec::new());
            }
            rows[row].push(p.estimate);
        }
    }
    let mean = |v: &Vec<f64>| if v.is_empty() { 0.0 } else { v.iter().sum::<f64>() / v.len() as f64 };
    let list: Vec<String> = rows.iter().rev().map(|v| format!("{:.4}", mean(v))).collect();
    let one = if rig.sensors.len() > 1 { "# One table serves for all sensors: the mean over them.\n" } else { "" };
    format!("{one}offsets_m = [{}]\n", list.join(", "))
}

/// A thin box a metre before the sensor that fills the blocked directions.
fn blocked_box(f: &Finding, rig: &SensorRig) -> String {
    let value = |quantity: Quantity| f.parameter(quantity).map_or(0.0, |p| p.estimate);
    let sensor = &rig.sensors[(value(Quantity::Sensor) as usize).min(rig.sensors.len() - 1)];
    let pose = sensor.pose();
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for az in [Quantity::AzimuthFromDeg, Quantity::AzimuthToDeg] {
        for el in [Quantity::ElevationFromDeg, Quantity::ElevationToDeg] {
            for distance in [1.0, 1.05] {
                let (a, e) = (value(az).to_radians(), value(el).to_radians());
                let p = pose
                    * nalgebra::Point3::new(
                        distance * e.cos() * a.cos(),
                        distance * e.cos() * a.sin(),
                        distance * e.sin(),
                    );
                for k in 0..3 {
                    low[k] = f64::min(low[k], p[k]);
                    high[k] = f64::max(high[k], p[k]);
                }
            }
        }
    }
    let numbers: Vec<String> = low.iter().chain(&high).map(|v| format!("{v:.3}")).collect();
    format!("[[effect]]\nkind = \"ego_body_mask\"\nboxes = [[{}]]\n", numbers.join(", "))
}

/// A patch of directions that loses more than others: the table over directions is a spot.
fn dirty_window(f: &Finding, rig: &SensorRig) -> String {
    let value = |quantity: Quantity| f.parameter(quantity).map_or(0.0, |p| p.estimate);
    let Some(mount) = rig.sensors.get(value(Quantity::Sensor) as usize) else { return String::new() };
    // Half of the light, one way: three quarters of `loss` in the middle.
    let loss = (value(Quantity::Share) / 0.75).clamp(0.0, 1.0);
    let line = |key: Quantity| {
        let interval = f.parameter(key).map(|p| format!(" # {} to {}", short(p.ci95[0]), short(p.ci95[1])));
        format!("{key} = {}{}\n", toml_number(value(key)), interval.unwrap_or_default())
    };
    let place = [Quantity::AzimuthDeg, Quantity::ElevationDeg, Quantity::RadiusDeg].map(line).concat();
    let window = format!(
        "sensor = \"{}\"\n{place}transmission = 0.5\nloss = {}\nnoise_m = 0.0\n",
        mount.name,
        toml_number(loss)
    );
    format!("[[effect]]\nkind = \"dirty_window\"\n{window}")
}

/// What has no name: for each sensor a table along its covariate.
fn empirical(f: &Finding, rig: &SensorRig, rows_deg: &[Vec<f64>]) -> String {
    if f.covariate == Covariate::Direction {
        return dirty_window(f, rig);
    }
    let usual = f.parameter(Quantity::SimulatedStdM).map_or(0.0, |p| p.estimate);
    let of_rows = f.covariate == Covariate::Row;
    let mut text = String::new();
    for (sensor, mount) in rig.sensors.iter().enumerate() {
        let own = f.curve.points.iter().filter(|p| p.sensor == sensor);
        let mut table: Vec<[f64; 3]> = own
            .filter_map(|p| {
                let at = if of_rows { *rows_deg.get(sensor)?.get(p.x as usize)? } else { p.x };
                let [value, error] = match f.channel {
                    Channel::Hits => [(1.0 - p.after).clamp(0.0, 1.0), p.error],
                    Channel::Roughness => [usual * (p.after * p.after - 1.0).max(0.0).sqrt(), usual * p.error],
                    _ => [p.after, p.error],
                };
                Some([at, value, error])
            })
            .collect();
        table.sort_by(|a, b| a[0].total_cmp(&b[0]));
        table.dedup_by(|a, b| a[0] - b[0] < 1e-3);
        if table.is_empty() {
            continue;
        }
        let list =
            |k: usize| table.iter().map(|p| format!("{:?}", (p[k] * 1e4).round() / 1e4)).collect::<Vec<_>>().join(", ");
        let key = match f.channel {
            Channel::Hits => "loss",
            Channel::Roughness => "std_m",
            _ => "mean_m",
        };
        let covariate = if of_rows { "elevation_deg" } else { "azimuth_deg" };
        let _ = write!(
            text,
            "[[effect]]\nkind = \"empirical\"\nsensor = \"{}\"\ncovariate = \"{covariate}\"\nat = [{}]\n{key} = [{}]\n# standard errors: {}\n",
            mount.name,
            list(0),
            list(1),
            list(2)
        );
    }
    text
}

fn short(v: f64) -> String {
    format!("{}", (v * 1e5).round() / 1e5)
}

fn toml_number(v: f64) -> String {
    format!("{:?}", (v * 1e7).round() / 1e7)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::catalogue::Unit;
    use crate::curve::{Curve, CurvePoint};
    use crate::diagnosis::{FindingGain, Gain, Parameter, SCHEMA, Verdict};
    use std::collections::BTreeMap;

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
            says: format!("says {cause}"),
            separate_by: None,
            curve: Curve::default(),
        }
    }

    fn with_rows(mut finding: Finding, offsets: [f64; 2]) -> Finding {
        for (row, v) in offsets.into_iter().enumerate() {
            let id = ParameterId::Row { sensor: "lidar".into(), row };
            finding.parameters.insert(id, Parameter { estimate: v, unit: Unit::Metre, ci95: [v - 0.001, v + 0.001] });
        }
        finding
    }

    fn diagnosis(findings: Vec<Finding>) -> Diagnosis {
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
            finding(Cause::LabelOffset, &[(Quantity::ForwardM, 0.3)]),
            finding(Cause::RangeNoise, &[(Quantity::StdM, 0.02), (Quantity::PerM, 0.0)]),
            finding(Cause::RandomDropout, &[(Quantity::Share, 0.2)]),
            finding(Cause::RandomDropout, &[(Quantity::Share, -0.2)]),
            finding(Cause::WrongShape, &[(Quantity::LongerM, 0.2)]),
        ]);
        let text = extended_toml(&diagnosis, &SensorRig::single(), &[]);
        let table: toml::Table = toml::from_str(&text).unwrap();
        let kinds: Vec<&str> =
            table["effect"].as_array().unwrap().iter().map(|e| e["kind"].as_str().unwrap()).collect();
        assert_eq!(kinds, ["random_dropout", "range_noise", "label_offset"]);
        assert!(text.contains("share = 0.2 # 0.18 to 0.22") && text.contains("take it out there"), "{text}");
        assert!(text.contains("mend its world"), "{text}");
    }

    #[test]
    fn the_simulator_reads_every_cause() {
        let unexplained = |channel: Channel, covariate: Covariate, at: &[f64]| Finding {
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
        };
        let findings = vec![
            finding(Cause::RangeNoise, &[(Quantity::StdM, 0.02), (Quantity::PerM, 1e-4)]),
            finding(Cause::RangeNoise, &[(Quantity::StdM, 0.02), (Quantity::PerM, 0.0)]),
            finding(Cause::SignalNoise, &[(Quantity::StdM, 0.02), (Quantity::Exponent, 0.5)]),
            finding(Cause::RangeBias, &[(Quantity::OffsetM, -0.02), (Quantity::Scale, 1e-3)]),
            with_rows(finding(Cause::BeamRangeOffset, &[(Quantity::StdM, 0.02)]), [0.01, -0.01]),
            finding(Cause::BeamElevationOffset, &[(Quantity::StdDeg, 0.1)]),
            finding(Cause::Quantisation, &[(Quantity::StepM, 0.02)]),
            finding(Cause::AngularJitter, &[(Quantity::StdDeg, 0.05)]),
            finding(Cause::RandomDropout, &[(Quantity::Share, 0.2)]),
            finding(Cause::SignalDropout, &[(Quantity::Threshold, 1.0), (Quantity::Steepness, 3.0)]),
            finding(Cause::IncidenceDropout, &[(Quantity::CosHalf, 0.1), (Quantity::Steepness, 3.0)]),
            finding(Cause::RangeDropout, &[(Quantity::HalfAtM, 50.0), (Quantity::Steepness, 6.0)]),
            finding(Cause::MaterialDropout, &[(Quantity::Share, 0.5)]),
            finding(Cause::RangeCut, &[(Quantity::MaxM, 80.0)]),
            finding(
                Cause::EgoOcclusion,
                &[
                    (Quantity::AzimuthFromDeg, -10.0),
                    (Quantity::AzimuthToDeg, 10.0),
                    (Quantity::ElevationFromDeg, -4.0),
                    (Quantity::ElevationToDeg, 1.0),
                ],
            ),
            finding(Cause::SensorExtrinsics, &[(Quantity::Sensor, 0.0), (Quantity::YawDeg, 0.2)]),
            finding(Cause::PitchRoll, &[(Quantity::PitchDeg, 0.2)]),
            finding(Cause::RollingShutter, &[(Quantity::ScanS, 0.1)]),
            finding(Cause::Outliers, &[(Quantity::Rate, 0.01), (Quantity::ReachM, 90.0)]),
            finding(Cause::MixedPixels, &[(Quantity::Share, 0.01), (Quantity::DivergenceRad, 0.004)]),
            finding(Cause::LabelOffset, &[(Quantity::ForwardM, 0.2)]),
            finding(Cause::TimeOffset, &[(Quantity::OffsetS, 0.02)]),
            finding(Cause::WrongShape, &[(Quantity::LongerM, 0.2)]),
            finding(Cause::MissingObject, &[(Quantity::Share, 0.02)]),
            unexplained(Channel::Hits, Covariate::Azimuth, &[-30.0, 10.0, 50.0]),
            unexplained(Channel::Roughness, Covariate::Row, &[0.0, 1.0]),
            unexplained(Channel::Residuals, Covariate::Azimuth, &[-30.0, 10.0]),
            Finding {
                parameters: finding(
                    Cause::Unexplained,
                    &[
                        (Quantity::Sensor, 0.0),
                        (Quantity::AzimuthDeg, -20.0),
                        (Quantity::ElevationDeg, -4.0),
                        (Quantity::RadiusDeg, 5.0),
                        (Quantity::Share, 0.4),
                    ],
                )
                .parameters,
                ..unexplained(Channel::Hits, Covariate::Direction, &[-20.0])
            },
        ];
        for f in findings {
            let what = f.cause.map_or(f.channel.name(), Cause::name);
            let diagnosis = diagnosis(vec![f]);
            let text = extended_toml(&diagnosis, &SensorRig::single(), &[vec![-5.0, -4.0]]);
            let read = simulate::effects::EffectList::parse(&text, std::path::Path::new("extended.toml"));
            let effects = read.unwrap_or_else(|e| panic!("{what}: {e}\n{text}")).effects;
            let of_the_world = matches!(what, "wrong_shape" | "missing_object");
            assert_eq!(effects.is_empty(), of_the_world, "{what}: {text}");
        }
    }
}
