//! Findings as effects of the sensor model: what a simulation has to be given to show the same.
//!
//! Every parameter of an effect is written: one that the finding does not have takes the value at which it changes
//! nothing, not the effect's default, which is a typical strength.

use crate::diagnosis::{Finding, Status};
use crate::inference::noise::USUAL_SIGNAL;
use crate::pairing::GAP_M;
use nalgebra::Point3;
use sensor::beams::Pick;
use sensor::effects::{
    AngularJitter, BeamAngleError, BeamDivergence, BeamRangeOffset, Clock, Covariate, DirtyWindow, Effect, EgoAttitude,
    EgoBodyMask, Empirical, FalseAlarms, IncidenceDropout, LabelOffset, LabelTimeOffset, MaterialDropout,
    RandomDropout, RangeBias, RangeDropout, RangeLimits, RangeNoise, RangeNoiseByIncidence, RangeNoiseByRange,
    RangeNoiseBySignal, RangeQuantisation, RollingShutter, SensorPoseError, SignalDropout,
};
use sensor::{Rig, Sensor};

/// A standard deviation of range that no finding reaches, m: the limit of an effect that has to be given one.
const NO_LIMIT_M: f64 = 10.0;
/// How far false points reach where a finding does not tell, m.
const USUAL_REACH_M: f64 = 200.0;

/// Gives every finding its effects. `rows_deg` holds the elevations of the rows of every sensor.
pub(crate) fn fill_effects(findings: &mut [Finding], rig: &Rig, rows_deg: &[Vec<f64>]) {
    for finding in findings {
        finding.effects = effects_of(finding, rig, rows_deg);
    }
}

/// The effects of a finding; none where the sensor model has none for it. Of an ambiguous finding those of its first
/// candidate.
pub(crate) fn effects_of(finding: &Finding, rig: &Rig, rows_deg: &[Vec<f64>]) -> Vec<Effect> {
    match finding.status {
        Status::Unexplained if finding.covariate == "direction" => dirty_window(finding, rig).into_iter().collect(),
        Status::Unexplained => tables(finding, rig, rows_deg),
        _ => named(finding, rig),
    }
}

/// The cause that a finding is mended by: its name, or the first candidate.
pub(crate) fn cause_of(finding: &Finding) -> &str {
    let first = || finding.candidates.as_ref().and_then(|c| c.first()).map(String::as_str);
    finding.cause.as_deref().or_else(first).unwrap_or_default()
}

/// A parameter's best value; 0 where the finding does not have it.
fn value(f: &Finding, name: &str) -> f64 {
    value_or(f, name, 0.0)
}

fn value_or(f: &Finding, name: &str, otherwise: f64) -> f64 {
    f.parameters.get(name).map_or(otherwise, |p| rounded(p.estimate, 7))
}

/// As many places behind the point as a file needs.
fn rounded(v: f64, places: i32) -> f64 {
    let scale = 10f64.powi(places);
    (v * scale).round() / scale
}

/// Share that a law loses where nothing of it is felt.
fn lost_anyway(f: &Finding) -> f64 {
    f.parameters.get("most").map_or(0.0, |most| (1.0 - most.estimate).max(0.0))
}

/// A negative strength is no effect: the simulation has too much of it.
fn positive(strength: f64, effect: impl Into<Option<Effect>>) -> Vec<Effect> {
    if strength < 0.0 { Vec::new() } else { effect.into().into_iter().collect() }
}

fn named(f: &Finding, rig: &Rig) -> Vec<Effect> {
    let value = |name: &str| value(f, name);
    let effect = match cause_of(f) {
        "range_noise" => return range_noise(f),
        "signal_noise" => Effect::RangeNoiseBySignal(RangeNoiseBySignal {
            std_m: value("std_m"),
            exponent: value("exponent"),
            signal: USUAL_SIGNAL,
            most_m: NO_LIMIT_M,
        }),
        "incidence_noise" => Effect::RangeNoiseByIncidence(RangeNoiseByIncidence {
            divergence_rad: rounded(2.0 * value("angle_rad"), 7),
            samples: 1.0,
            most_m: NO_LIMIT_M,
        }),
        "range_bias" => Effect::RangeBias(RangeBias { offset_m: value("offset_m"), scale: value("scale") }),
        "beam_range_offset" => {
            Effect::BeamRangeOffset(BeamRangeOffset { std_m: 0.0, offsets_m: row_offsets_m(f, rig) })
        }
        "beam_elevation_offset" => Effect::BeamAngleError(BeamAngleError {
            elevation_deg: value("mean_deg"),
            elevation_std_deg: value("std_deg"),
            azimuth_std_deg: 0.0,
        }),
        "quantisation" => Effect::RangeQuantisation(RangeQuantisation { step_m: value("step_m") }),
        "angular_jitter" => {
            let std_deg = value("std_deg");
            let jitter = AngularJitter { azimuth_std_deg: std_deg, elevation_std_deg: std_deg };
            return positive(std_deg, Effect::AngularJitter(jitter));
        }
        "range_cut" => Effect::RangeLimits(RangeLimits { min_m: 0.0, max_m: value("max_m") }),
        "ego_occlusion" => Effect::EgoBodyMask(EgoBodyMask { boxes: vec![blocked_box(f, rig)] }),
        "sensor_extrinsics" => Effect::SensorPoseError(SensorPoseError {
            sensor: sensor_of(f, rig).name.clone(),
            translation_m: ["forward_m", "left_m", "up_m"].map(value),
            rotation_deg: ["roll_deg", "pitch_deg", "yaw_deg"].map(value),
        }),
        "pitch_roll" => Effect::EgoAttitude(EgoAttitude {
            roll_deg: value("roll_deg"),
            pitch_deg: value("pitch_deg"),
            pitch_at_70mps_deg: 0.0,
            roll_std_deg: 0.0,
            pitch_std_deg: 0.0,
            heave_std_m: 0.0,
        }),
        "rolling_shutter" => Effect::RollingShutter(RollingShutter { deskewed: false }),
        "outliers" => Effect::FalseAlarms(FalseAlarms {
            rate: value("rate"),
            sun_rate: 0.0,
            reach_m: value_or(f, "reach_m", USUAL_REACH_M),
            ..FalseAlarms::default()
        }),
        // Ranges that mix over such jumps come from pulses, or modulations, as long as that.
        "mixed_pixels" if f.parameters.contains_key("divergence_rad") => Effect::BeamDivergence(BeamDivergence {
            divergence_rad: value("divergence_rad"),
            rays: 7,
            pulse_m: GAP_M[1],
            pick: Pick::Strongest,
        }),
        "label_offset" => Effect::LabelOffset(LabelOffset {
            forward_m: value("forward_m"),
            left_m: value("left_m"),
            up_m: value("up_m"),
            yaw_deg: 0.0,
        }),
        "time_offset" => Effect::LabelTimeOffset(LabelTimeOffset {
            offset_s: value("offset_s"),
            clock: if f.covariate == "seen_velocity_m_s" { Clock::Cloud } else { Clock::Cars },
        }),
        _ => return losses(f),
    };
    vec![effect]
}

fn range_noise(f: &Finding) -> Vec<Effect> {
    let (std_m, per_m) = (value(f, "std_m"), value(f, "per_m"));
    if per_m > 0.0 {
        let noise = RangeNoiseByRange { base_m: std_m, per_m, quadratic: false };
        return vec![Effect::RangeNoiseByRange(noise)];
    }
    positive(std_m, Effect::RangeNoise(RangeNoise { std_m }))
}

/// Causes by which returns are lost; none for what changes the world.
fn losses(f: &Finding) -> Vec<Effect> {
    let random = |share: f64| Effect::RandomDropout(RandomDropout { share });
    match cause_of(f) {
        "random_dropout" => positive(value(f, "share"), random(value(f, "share"))),
        "signal_dropout" => vec![Effect::SignalDropout(SignalDropout {
            most: value_or(f, "most", 1.0),
            threshold: value(f, "threshold"),
            steepness: value(f, "steepness"),
            attenuation_per_m: 0.0,
        })],
        "incidence_dropout" => {
            let cos_half = value(f, "cos_half");
            // The simulator's step is one over the cosine, the finding's one over its logarithm: as steep at one half.
            let steepness = rounded(value(f, "steepness") / cos_half.max(1e-3), 7);
            let dropout = Effect::IncidenceDropout(IncidenceDropout { cos_half, steepness });
            let anyway = (lost_anyway(f) > 0.0).then(|| random(rounded(lost_anyway(f), 7)));
            std::iter::once(dropout).chain(anyway).collect()
        }
        "range_dropout" => vec![Effect::RangeDropout(range_dropout(f))],
        "material_dropout" => {
            let material = match f.covariate.as_str() {
                "surface: ground" => "asphalt",
                "surface: standing" => "concrete",
                "surface: object_corner" => "rubber",
                _ => "paint",
            };
            let share = value(f, "share");
            positive(share, Effect::MaterialDropout(MaterialDropout { materials: vec![material.into()], share }))
        }
        _ => Vec::new(),
    }
}

/// The law over range as a table.
fn range_dropout(f: &Finding) -> RangeDropout {
    let (half, steepness) = (value(f, "half_at_m").max(1e-3), value(f, "steepness"));
    let most = 1.0 - lost_anyway(f);
    let kept = |r: f64| if r > 0.0 { most / (1.0 + (r / half).powf(steepness)) } else { most };
    let range_m: Vec<f64> = (0..=24).map(|i| 5.0 * f64::from(i)).collect();
    let share = range_m.iter().map(|r| rounded(1.0 - kept(*r), 4)).collect();
    RangeDropout { range_m, share }
}

/// Offsets of rows from the top, the mean of all sensors.
fn row_offsets_m(f: &Finding, rig: &Rig) -> Vec<f64> {
    let mut rows: Vec<Vec<f64>> = Vec::new();
    for sensor in &rig.sensors {
        for (name, p) in &f.parameters {
            let row = name.strip_prefix(&format!("{}/", sensor.name)).and_then(|r| r.parse::<usize>().ok());
            let Some(row) = row else { continue };
            if rows.len() <= row {
                rows.resize(row + 1, Vec::new());
            }
            rows[row].push(p.estimate);
        }
    }
    let mean = |v: &Vec<f64>| if v.is_empty() { 0.0 } else { v.iter().sum::<f64>() / v.len() as f64 };
    rows.iter().rev().map(|v| rounded(mean(v), 4)).collect()
}

/// The sensor that a finding speaks of.
fn sensor_of<'a>(f: &Finding, rig: &'a Rig) -> &'a Sensor {
    &rig.sensors[(value(f, "sensor") as usize).min(rig.sensors.len() - 1)]
}

/// A thin box a metre before the sensor that fills the blocked directions.
fn blocked_box(f: &Finding, rig: &Rig) -> [f64; 6] {
    let radians = |name: &str| f.parameters.get(name).map_or(0.0, |p| p.estimate.to_radians());
    let pose = sensor_of(f, rig).pose();
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for azimuth in ["azimuth_from_deg", "azimuth_to_deg"] {
        for elevation in ["elevation_from_deg", "elevation_to_deg"] {
            for distance in [1.0, 1.05] {
                let (a, e) = (radians(azimuth), radians(elevation));
                let p = Point3::new(e.cos() * a.cos(), e.cos() * a.sin(), e.sin()) * distance;
                let p = pose * p;
                for k in 0..3 {
                    low[k] = f64::min(low[k], p[k]);
                    high[k] = f64::max(high[k], p[k]);
                }
            }
        }
    }
    let [low, high] = [low, high].map(|corner| corner.map(|v| rounded(v, 3)));
    [low[0], low[1], low[2], high[0], high[1], high[2]]
}

/// A patch of directions that loses more than others: the table over directions is a spot.
fn dirty_window(f: &Finding, rig: &Rig) -> Option<Effect> {
    let sensor = rig.sensors.get(value(f, "sensor") as usize)?;
    Some(Effect::DirtyWindow(DirtyWindow {
        sensor: sensor.name.clone(),
        azimuth_deg: value(f, "azimuth_deg"),
        elevation_deg: value(f, "elevation_deg"),
        radius_deg: value(f, "radius_deg"),
        // Half of the light, one way: three quarters of `loss` in the middle.
        transmission: 0.5,
        loss: rounded((value(f, "share") / 0.75).clamp(0.0, 1.0), 7),
        noise_m: 0.0,
    }))
}

/// What has no name: for each sensor a table along its covariate.
fn tables(f: &Finding, rig: &Rig, rows_deg: &[Vec<f64>]) -> Vec<Effect> {
    let of_sensor = |(number, sensor): (usize, &Sensor)| {
        let table = table_of_sensor(f, number, rows_deg);
        if table.is_empty() {
            return None;
        }
        let mut effect = Empirical {
            sensor: sensor.name.clone(),
            covariate: if f.covariate == "row" { Covariate::ElevationDeg } else { Covariate::AzimuthDeg },
            at: table.iter().map(|p| rounded(p[0], 4)).collect(),
            ..Empirical::default()
        };
        let values = table.iter().map(|p| rounded(p[1], 4)).collect();
        match f.channel.as_str() {
            "hits" => effect.loss = values,
            "roughness" => effect.std_m = values,
            _ => effect.mean_m = values,
        }
        Some(Effect::Empirical(effect))
    };
    rig.sensors.iter().enumerate().filter_map(of_sensor).collect()
}

/// Place and value of the points of one sensor's curve, ascending.
fn table_of_sensor(f: &Finding, sensor: usize, rows_deg: &[Vec<f64>]) -> Vec<[f64; 2]> {
    let usual = f.parameters.get("simulated_std_m").map_or(0.0, |p| p.estimate);
    // Curves of sensors stand a thousand apart.
    let own = f.curve.points.iter().filter(|p| (p.x / 1000.0).round() == sensor as f64);
    let point = |p: &crate::diagnosis::CurvePoint| {
        let x = p.x - 1000.0 * sensor as f64;
        let at = if f.covariate == "row" { *rows_deg.get(sensor)?.get(x as usize)? } else { x };
        let value = match f.channel.as_str() {
            "hits" => (1.0 - p.after).clamp(0.0, 1.0),
            "roughness" => usual * (p.after * p.after - 1.0).max(0.0).sqrt(),
            _ => p.after,
        };
        Some([at, value])
    };
    let mut table: Vec<[f64; 2]> = own.filter_map(point).collect();
    table.sort_by(|a, b| a[0].total_cmp(&b[0]));
    table.dedup_by(|a, b| a[0] - b[0] < 1e-3);
    table
}
