//! Findings as effects of the sensor model: what a simulation has to be given to show the same.
//!
//! Every parameter of an effect is written: one that the finding does not have takes the value at which it changes
//! nothing.

use crate::catalogue::{Cause, Channel, Covariate, ParameterId, Quantity};
use crate::curve::CurvePoint;
use crate::diagnosis::{Finding, Status};
use crate::inference::noise::USUAL_SIGNAL;
use crate::pairing::GAP_M;
use nalgebra::Point3;
use sensor::beams::Pick;
use sensor::effects::{
    AngularJitter, BeamAngleError, BeamDivergence, BeamRangeOffset, Clock, Covariate as TableCovariate, DirtyWindow,
    Effect, EgoAttitude, EgoBodyMask, Empirical, FalseAlarms, IncidenceDropout, LabelOffset, LabelTimeOffset,
    MaterialDropout, RandomDropout, RangeBias, RangeDropout, RangeLimits, RangeNoise, RangeNoiseByIncidence,
    RangeNoiseByRange, RangeNoiseBySignal, RangeQuantisation, RollingShutter, SensorPoseError, SignalDropout,
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
        Status::Unexplained if finding.covariate == Covariate::Direction => {
            dirty_window(finding, rig).into_iter().collect()
        }
        Status::Unexplained => tables(finding, rig, rows_deg),
        _ => named(finding, rig),
    }
}

/// The cause whose effect corrects the simulation: the named one, or the first candidate.
pub(crate) fn cause_of(finding: &Finding) -> Cause {
    let first = || finding.candidates.as_ref().and_then(|c| c.first()).copied();
    finding.cause.or_else(first).unwrap_or(Cause::Unexplained)
}

/// A parameter's best value; 0 where the finding does not have it.
fn value(f: &Finding, quantity: Quantity) -> f64 {
    value_or(f, quantity, 0.0)
}

fn value_or(f: &Finding, quantity: Quantity, otherwise: f64) -> f64 {
    f.parameter(quantity).map_or(otherwise, |p| rounded(p.estimate, 7))
}

/// As many places behind the point as a file needs.
fn rounded(v: f64, places: i32) -> f64 {
    let scale = 10f64.powi(places);
    (v * scale).round() / scale
}

/// Share of the returns that are lost where the law has no effect.
fn lost_anyway(f: &Finding) -> f64 {
    f.parameter(Quantity::Most).map_or(0.0, |most| (1.0 - most.estimate).max(0.0))
}

/// A negative strength is no effect: the simulation has too much of it.
fn positive(strength: f64, effect: impl Into<Option<Effect>>) -> Vec<Effect> {
    if strength < 0.0 { Vec::new() } else { effect.into().into_iter().collect() }
}

/// The effects of a named cause.
#[expect(clippy::too_many_lines, reason = "a table: one arm for each cause")]
fn named(f: &Finding, rig: &Rig) -> Vec<Effect> {
    let value = |quantity: Quantity| value(f, quantity);
    let effect = match cause_of(f) {
        Cause::RangeNoise => return range_noise(f),
        Cause::SignalNoise => Effect::RangeNoiseBySignal(RangeNoiseBySignal {
            std_m: value(Quantity::StdM),
            exponent: value(Quantity::Exponent),
            signal: USUAL_SIGNAL,
            most_m: NO_LIMIT_M,
        }),
        Cause::IncidenceNoise => Effect::RangeNoiseByIncidence(RangeNoiseByIncidence {
            divergence_rad: rounded(2.0 * value(Quantity::AngleRad), 7),
            samples: 1.0,
            most_m: NO_LIMIT_M,
        }),
        Cause::RangeBias => {
            Effect::RangeBias(RangeBias { offset_m: value(Quantity::OffsetM), scale: value(Quantity::Scale) })
        }
        Cause::BeamRangeOffset => {
            Effect::BeamRangeOffset(BeamRangeOffset { std_m: 0.0, offsets_m: row_offsets_m(f, rig) })
        }
        Cause::BeamElevationOffset => Effect::BeamAngleError(BeamAngleError {
            elevation_deg: value(Quantity::MeanDeg),
            elevation_std_deg: value(Quantity::StdDeg),
            azimuth_std_deg: 0.0,
        }),
        Cause::Quantisation => Effect::RangeQuantisation(RangeQuantisation { step_m: value(Quantity::StepM) }),
        Cause::AngularJitter => {
            let std_deg = value(Quantity::StdDeg);
            let jitter = AngularJitter { azimuth_std_deg: std_deg, elevation_std_deg: std_deg };
            return positive(std_deg, Effect::AngularJitter(jitter));
        }
        Cause::RangeCut => Effect::RangeLimits(RangeLimits { min_m: 0.0, max_m: value(Quantity::MaxM) }),
        Cause::EgoOcclusion => Effect::EgoBodyMask(EgoBodyMask { boxes: vec![blocked_box(f, rig)] }),
        Cause::SensorExtrinsics => Effect::SensorPoseError(SensorPoseError {
            sensor: sensor_of(f, rig).name.clone(),
            translation_m: [Quantity::ForwardM, Quantity::LeftM, Quantity::UpM].map(value),
            rotation_deg: [Quantity::RollDeg, Quantity::PitchDeg, Quantity::YawDeg].map(value),
        }),
        Cause::PitchRoll => Effect::EgoAttitude(EgoAttitude {
            roll_deg: value(Quantity::RollDeg),
            pitch_deg: value(Quantity::PitchDeg),
            pitch_at_70mps_deg: 0.0,
            roll_std_deg: 0.0,
            pitch_std_deg: 0.0,
            heave_std_m: 0.0,
        }),
        Cause::RollingShutter => Effect::RollingShutter(RollingShutter { deskewed: false }),
        Cause::Outliers => Effect::FalseAlarms(FalseAlarms {
            rate: value(Quantity::Rate),
            sun_rate: 0.0,
            reach_m: value_or(f, Quantity::ReachM, USUAL_REACH_M),
            ..FalseAlarms::default()
        }),
        // Ranges that mix over such jumps come from pulses, or modulations, as long as that.
        Cause::MixedPixels if f.parameter(Quantity::DivergenceRad).is_some() => {
            Effect::BeamDivergence(BeamDivergence {
                divergence_rad: value(Quantity::DivergenceRad),
                rays: 7,
                pulse_m: GAP_M[1],
                pick: Pick::Strongest,
            })
        }
        Cause::LabelOffset => Effect::LabelOffset(LabelOffset {
            forward_m: value(Quantity::ForwardM),
            left_m: value(Quantity::LeftM),
            up_m: value(Quantity::UpM),
            yaw_deg: 0.0,
        }),
        Cause::TimeOffset => Effect::LabelTimeOffset(LabelTimeOffset {
            offset_s: value(Quantity::OffsetS),
            clock: if f.covariate == Covariate::SeenVelocity { Clock::Cloud } else { Clock::Cars },
        }),
        _ => return losses(f),
    };
    vec![effect]
}

fn range_noise(f: &Finding) -> Vec<Effect> {
    let (std_m, per_m) = (value(f, Quantity::StdM), value(f, Quantity::PerM));
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
        Cause::RandomDropout => positive(value(f, Quantity::Share), random(value(f, Quantity::Share))),
        Cause::SignalDropout => vec![Effect::SignalDropout(SignalDropout {
            most: value_or(f, Quantity::Most, 1.0),
            threshold: value(f, Quantity::Threshold),
            steepness: value(f, Quantity::Steepness),
            attenuation_per_m: 0.0,
        })],
        Cause::IncidenceDropout => {
            let cos_half = value(f, Quantity::CosHalf);
            // The simulator's step is one over the cosine, the finding's one over its logarithm: as steep at one half.
            let steepness = rounded(value(f, Quantity::Steepness) / cos_half.max(1e-3), 7);
            let dropout = Effect::IncidenceDropout(IncidenceDropout { cos_half, steepness });
            let anyway = (lost_anyway(f) > 0.0).then(|| random(rounded(lost_anyway(f), 7)));
            std::iter::once(dropout).chain(anyway).collect()
        }
        Cause::RangeDropout => vec![Effect::RangeDropout(range_dropout(f))],
        Cause::MaterialDropout => {
            let material = match f.covariate {
                Covariate::SurfaceGround => "asphalt",
                Covariate::SurfaceStanding => "concrete",
                Covariate::SurfaceObjectCorner => "rubber",
                _ => "paint",
            };
            let share = value(f, Quantity::Share);
            positive(share, Effect::MaterialDropout(MaterialDropout { materials: vec![material.into()], share }))
        }
        _ => Vec::new(),
    }
}

/// The law over range as a table.
fn range_dropout(f: &Finding) -> RangeDropout {
    let (half, steepness) = (value(f, Quantity::HalfAtM).max(1e-3), value(f, Quantity::Steepness));
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
        for (id, p) in &f.parameters {
            let row = match id {
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
    rows.iter().rev().map(|v| rounded(mean(v), 4)).collect()
}

/// The sensor of a finding.
fn sensor_of<'a>(f: &Finding, rig: &'a Rig) -> &'a Sensor {
    &rig.sensors[(value(f, Quantity::Sensor) as usize).min(rig.sensors.len() - 1)]
}

/// A thin box a metre before the sensor that fills the blocked directions.
fn blocked_box(f: &Finding, rig: &Rig) -> [f64; 6] {
    let radians = |quantity: Quantity| f.parameter(quantity).map_or(0.0, |p| p.estimate.to_radians());
    let pose = sensor_of(f, rig).pose();
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for azimuth in [Quantity::AzimuthFromDeg, Quantity::AzimuthToDeg] {
        for elevation in [Quantity::ElevationFromDeg, Quantity::ElevationToDeg] {
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
    let sensor = rig.sensors.get(value(f, Quantity::Sensor) as usize)?;
    Some(Effect::DirtyWindow(DirtyWindow {
        sensor: sensor.name.clone(),
        azimuth_deg: value(f, Quantity::AzimuthDeg),
        elevation_deg: value(f, Quantity::ElevationDeg),
        radius_deg: value(f, Quantity::RadiusDeg),
        // Half of the light, one way: three quarters of `loss` in the middle.
        transmission: 0.5,
        loss: rounded((value(f, Quantity::Share) / 0.75).clamp(0.0, 1.0), 7),
        noise_m: 0.0,
    }))
}

/// An unexplained finding: for each sensor a table along its covariate.
fn tables(f: &Finding, rig: &Rig, rows_deg: &[Vec<f64>]) -> Vec<Effect> {
    let of_sensor = |(number, sensor): (usize, &Sensor)| {
        let table = table_of_sensor(f, number, rows_deg);
        if table.is_empty() {
            return None;
        }
        let mut effect = Empirical {
            sensor: sensor.name.clone(),
            covariate: match f.covariate {
                Covariate::Row => TableCovariate::ElevationDeg,
                _ => TableCovariate::AzimuthDeg,
            },
            at: table.iter().map(|p| rounded(p[0], 4)).collect(),
            ..Empirical::default()
        };
        let values = table.iter().map(|p| rounded(p[1], 4)).collect();
        match f.channel {
            Channel::Hits => effect.loss = values,
            Channel::Roughness => effect.std_m = values,
            _ => effect.mean_m = values,
        }
        Some(Effect::Empirical(effect))
    };
    rig.sensors.iter().enumerate().filter_map(of_sensor).collect()
}

/// Place and value of the points of one sensor's curve, ascending.
fn table_of_sensor(f: &Finding, sensor: usize, rows_deg: &[Vec<f64>]) -> Vec<[f64; 2]> {
    let usual = f.parameter(Quantity::SimulatedStdM).map_or(0.0, |p| p.estimate);
    let own = f.curve.points.iter().filter(|p| p.sensor == sensor);
    let point = |p: &CurvePoint| {
        let at = if f.covariate == Covariate::Row { *rows_deg.get(sensor)?.get(p.x as usize)? } else { p.x };
        let value = match f.channel {
            Channel::Hits => (1.0 - p.after).clamp(0.0, 1.0),
            Channel::Roughness => usual * (p.after * p.after - 1.0).max(0.0).sqrt(),
            _ => p.after,
        };
        Some([at, value])
    };
    let mut table: Vec<[f64; 2]> = own.filter_map(point).collect();
    table.sort_by(|a, b| a[0].total_cmp(&b[0]));
    table.dedup_by(|a, b| a[0] - b[0] < 1e-3);
    table
}
