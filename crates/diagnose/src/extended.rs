//! The file `extended.toml`: what was found as a list of effects for the simulator, with intervals as comments. What the simulator has no
//! effect for is listed in comments; what has no name is written as tables.

use crate::diagnosis::{Diagnosis, Finding, Status};
use crate::pairing::GAP_M;
use crate::rig::SensorRig;
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

/// The text of `extended.toml`. `rows_deg` holds the elevations of the rows of every sensor.
pub fn extended_toml(diagnosis: &Diagnosis, rig: &SensorRig, rows_deg: &[Vec<f64>]) -> String {
    let mut text = String::from(
        "# What the diagnosis adds to the simulation's sensor model: a list of effects. Intervals (95 %) stand behind the values.\n",
    );
    let place =
        |f: &Finding| f.cause.as_deref().and_then(|c| ORDER.iter().position(|o| *o == c)).unwrap_or(ORDER.len());
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
                    names.join(" and ")
                );
                let first = Finding { cause: names.first().cloned(), ..f.clone() };
                text.push_str(&named(&first, rig));
            }
            Status::Unexplained => text.push_str(&empirical(f, rig, rows_deg)),
        }
    }
    text
}

/// Share that a law loses where nothing of it is felt.
fn lost_anyway(f: &Finding) -> f64 {
    f.parameters.get("most").map_or(0.0, |most| (1.0 - most.estimate).max(0.0))
}

/// One effect as the simulator reads it.
fn named(f: &Finding, rig: &SensorRig) -> String {
    let value = |name: &str| f.parameters.get(name).map_or(0.0, |p| p.estimate);
    let key = |key: &str, name: &str| -> String {
        f.parameters.get(name).map_or_else(String::new, |p| {
            let [low, high] = p.ci95.map(short);
            format!("{key} = {} # {low} to {high}\n", toml_number(p.estimate))
        })
    };
    let with = |kind: &str, lines: String| format!("[[effect]]\nkind = \"{kind}\"\n{lines}");
    match f.cause.as_deref().unwrap_or_default() {
        "range_noise" if value("per_m") > 0.0 => {
            with("range_noise_by_range", key("base_m", "std_m") + &key("per_m", "per_m"))
        }
        "range_noise" => positive(f, "std_m", with("range_noise", key("std_m", "std_m"))),
        "signal_noise" => with(
            "range_noise_by_signal",
            key("std_m", "std_m")
                + &key("exponent", "exponent")
                + &format!("signal = {:?}\n", crate::inference::noise::USUAL_SIGNAL),
        ),
        "incidence_noise" => with(
            "range_noise_by_incidence",
            format!("divergence_rad = {}\nsamples = 1.0\n", toml_number(2.0 * value("angle_rad"))),
        ),
        "range_bias" => with("range_bias", key("offset_m", "offset_m") + &key("scale", "scale")),
        "beam_range_offset" => with("beam_range_offset", row_table(f, rig)),
        "beam_elevation_offset" => {
            let none = if f.parameters.contains_key("std_deg") { "" } else { "elevation_std_deg = 0.0\n" };
            let lines = key("elevation_deg", "mean_deg") + &key("elevation_std_deg", "std_deg") + none;
            with("beam_angle_error", lines + "azimuth_std_deg = 0.0\n")
        }
        "quantisation" => with("range_quantisation", key("step_m", "step_m")),
        "angular_jitter" => positive(
            f,
            "std_deg",
            with("angular_jitter", key("azimuth_std_deg", "std_deg") + &key("elevation_std_deg", "std_deg")),
        ),
        "random_dropout" => positive(f, "share", with("random_dropout", key("share", "share"))),
        "signal_dropout" => with(
            "signal_dropout",
            key("threshold", "threshold") + &key("steepness", "steepness") + &key("most", "most"),
        ),
        "incidence_dropout" => {
            // The simulator's step is one over the cosine, the finding's one over its logarithm: as steep at one half.
            let steepness = toml_number(value("steepness") / value("cos_half").max(1e-3));
            let mut text =
                with("incidence_dropout", key("cos_half", "cos_half") + &format!("steepness = {steepness}\n"));
            if lost_anyway(f) > 0.0 {
                text += &with("random_dropout", format!("share = {}\n", toml_number(lost_anyway(f))));
            }
            text
        }
        "range_dropout" => {
            let (half, steepness) = (value("half_at_m").max(1e-3), value("steepness"));
            let ranges: Vec<f64> = (0..=24).map(|i| 5.0 * f64::from(i)).collect();
            let most = 1.0 - lost_anyway(f);
            let kept = |r: f64| if r > 0.0 { most / (1.0 + (r / half).powf(steepness)) } else { most };
            let lost = ranges.iter().map(|r| 1.0 - kept(*r));
            let lost: Vec<String> = lost.map(|v| format!("{v:.4}")).collect();
            let ranges: Vec<String> = ranges.iter().map(|r| format!("{r:.1}")).collect();
            with("range_dropout", format!("range_m = [{}]\nshare = [{}]\n", ranges.join(", "), lost.join(", ")))
        }
        "material_dropout" => {
            let materials = match f.covariate.as_str() {
                "surface: ground" => "\"asphalt\"",
                "surface: standing" => "\"concrete\"",
                "surface: object_corner" => "\"rubber\"",
                _ => "\"paint\"",
            };
            positive(
                f,
                "share",
                with("material_dropout", format!("materials = [{materials}]\n") + &key("share", "share")),
            )
        }
        "range_cut" => with("range_limits", key("max_m", "max_m")),
        "ego_occlusion" => blocked_box(f, rig),
        "sensor_extrinsics" => {
            let sensor = &rig.sensors[(value("sensor") as usize).min(rig.sensors.len() - 1)].name;
            let three = |names: [&str; 3]| names.map(|n| toml_number(value(n))).join(", ");
            let intervals: Vec<String> = f
                .parameters
                .iter()
                .filter(|(n, _)| *n != "sensor")
                .map(|(n, p)| format!("# {n}: {} to {}\n", short(p.ci95[0]), short(p.ci95[1])))
                .collect();
            with(
                "sensor_pose_error",
                format!(
                    "sensor = \"{sensor}\"\ntranslation_m = [{}]\nrotation_deg = [{}]\n{}",
                    three(["forward_m", "left_m", "up_m"]),
                    three(["roll_deg", "pitch_deg", "yaw_deg"]),
                    intervals.concat()
                ),
            )
        }
        "pitch_roll" => {
            let steady = |key: &str, name: &str| {
                if f.parameters.contains_key(name) { String::new() } else { format!("{key} = 0.0\n") }
            };
            let lines = key("roll_deg", "roll_deg")
                + &key("pitch_deg", "pitch_deg")
                + &steady("roll_deg", "roll_deg")
                + &steady("pitch_deg", "pitch_deg")
                + "roll_std_deg = 0.0\npitch_std_deg = 0.0\n";
            with("ego_attitude", lines)
        }
        "rolling_shutter" => with("rolling_shutter", "deskewed = false\n".into()),
        "outliers" => with("false_alarms", key("rate", "rate") + &key("reach_m", "reach_m")),
        // Ranges that mix over such jumps come from pulses, or modulations, as long as that.
        "mixed_pixels" if !f.parameters.contains_key("divergence_rad") => {
            "# beam_divergence: how wide the beams are these data do not tell.\n".into()
        }
        "mixed_pixels" => {
            with("beam_divergence", key("divergence_rad", "divergence_rad") + &format!("pulse_m = {:?}\n", GAP_M[1]))
        }
        "label_offset" => {
            with("label_offset", key("forward_m", "forward_m") + &key("left_m", "left_m") + &key("up_m", "up_m"))
        }
        "time_offset" => {
            let clock = if f.covariate == "seen_velocity_m_s" { "cloud" } else { "cars" };
            with("label_time_offset", key("offset_s", "offset_s") + &format!("clock = \"{clock}\"\n"))
        }
        other => format!("# The simulator has no effect that does this by itself ({other}): mend its world.\n"),
    }
}

/// A simulation that has too much of something is mended by taking it out, not by an effect.
fn positive(f: &Finding, name: &str, text: String) -> String {
    if f.parameters.get(name).is_some_and(|p| p.estimate < 0.0) {
        return format!(
            "# The simulation has more of it than the measurement: take it out there ({name} by {}).\n",
            short(f.parameters[name].estimate)
        );
    }
    text
}

/// Offsets of rows from the top, the mean of all sensors.
fn row_table(f: &Finding, rig: &SensorRig) -> String {
    let mut rows: Vec<Vec<f64>> = Vec::new();
    for sensor in &rig.sensors {
        for (name, p) in &f.parameters {
            let Some(row) = name.strip_prefix(&format!("{}/", sensor.name)).and_then(|r| r.parse::<usize>().ok())
            else {
                continue;
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
    let value = |name: &str| f.parameters.get(name).map_or(0.0, |p| p.estimate);
    let sensor = &rig.sensors[(value("sensor") as usize).min(rig.sensors.len() - 1)];
    let pose = sensor.pose();
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for az in ["azimuth_from_deg", "azimuth_to_deg"] {
        for el in ["elevation_from_deg", "elevation_to_deg"] {
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
    let value = |name: &str| f.parameters.get(name).map_or(0.0, |p| p.estimate);
    let Some(mount) = rig.sensors.get(value("sensor") as usize) else { return String::new() };
    // Half of the light, one way: three quarters of `loss` in the middle.
    let loss = (value("share") / 0.75).clamp(0.0, 1.0);
    let line = |key: &str| {
        let interval = f.parameters.get(key).map(|p| format!(" # {} to {}", short(p.ci95[0]), short(p.ci95[1])));
        format!("{key} = {}{}\n", toml_number(value(key)), interval.unwrap_or_default())
    };
    let place = ["azimuth_deg", "elevation_deg", "radius_deg"].map(line).concat();
    let window = format!(
        "sensor = \"{}\"\n{place}transmission = 0.5\nloss = {}\nnoise_m = 0.0\n",
        mount.name,
        toml_number(loss)
    );
    format!("[[effect]]\nkind = \"dirty_window\"\n{window}")
}

/// What has no name: for each sensor a table along its covariate.
fn empirical(f: &Finding, rig: &SensorRig, rows_deg: &[Vec<f64>]) -> String {
    if f.covariate == "direction" {
        return dirty_window(f, rig);
    }
    let usual = f.parameters.get("simulated_std_m").map_or(0.0, |p| p.estimate);
    let of_rows = f.covariate == "row";
    let mut text = String::new();
    for (sensor, mount) in rig.sensors.iter().enumerate() {
        // Curves of sensors stand a thousand apart.
        let own = f.curve.points.iter().filter(|p| (p.x / 1000.0).round() == sensor as f64);
        let mut table: Vec<[f64; 3]> = own
            .filter_map(|p| {
                let x = p.x - 1000.0 * sensor as f64;
                let at = if of_rows { *rows_deg.get(sensor)?.get(x as usize)? } else { x };
                let [value, error] = match f.channel.as_str() {
                    "hits" => [(1.0 - p.after).clamp(0.0, 1.0), p.error],
                    "roughness" => [usual * (p.after * p.after - 1.0).max(0.0).sqrt(), usual * p.error],
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
        let key = match f.channel.as_str() {
            "hits" => "loss",
            "roughness" => "std_m",
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
    use crate::diagnosis::{Curve, CurvePoint, FindingGain, Gain, Parameter, SCHEMA, Verdict};
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
        }
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
            finding("label_offset", &[("forward_m", 0.3)]),
            finding("range_noise", &[("std_m", 0.02), ("per_m", 0.0)]),
            finding("random_dropout", &[("share", 0.2)]),
            finding("random_dropout", &[("share", -0.2)]),
            finding("wrong_shape", &[("longer_m", 0.2)]),
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
            let text = extended_toml(&diagnosis, &SensorRig::single(), &[vec![-5.0, -4.0]]);
            let read = simulate::effects::EffectList::parse(&text, std::path::Path::new("extended.toml"));
            let effects = read.unwrap_or_else(|e| panic!("{what}: {e}\n{text}")).effects;
            let of_the_world = matches!(what.as_str(), "wrong_shape" | "missing_object");
            assert_eq!(effects.is_empty(), of_the_world, "{what}: {text}");
        }
    }
}
