//! Findings as effects of the sensor model: what a simulation has to be given to show the same.
//!
//! Every parameter of an effect is written: one that the finding does not have takes the value at which it changes
//! nothing.

use crate::catalogue::{Cause, Channel, Covariate, ParameterId, Quantity};
use crate::channels::spot::TRANSMISSION;
use crate::curve::CurvePoint;
use crate::diagnosis::{Finding, Status};
use crate::inference::noise::USUAL_SIGNAL;
use sensor::beams::Pick;
use sensor::directions::{ScanPattern, Sensors};
use sensor::effects::{
    AngularJitter, AssumedReflectivity, BeamAngleError, BeamDivergence, BeamIntensity, BeamRangeOffset, Clock,
    CoordinateRounding, Covariate as TableCovariate, DirtyWindow, DualReturns, Effect, EgoAttitude, Empirical,
    LabelOffset, LabelTimeOffset, PacketLoss, RangeBias, RangeLimits, RangeNoise, RangeNoiseByIncidence,
    RangeNoiseByRange, RangeNoiseBySignal, RangeQuantisation, RollingShutter, SensorPoseError,
};
use sensor::signal::DIAGNOSIS_REFLECTIVITY;
use sensor::{Rig, Sensor};

/// A standard deviation of range that no finding reaches, m: the limit of an effect that has to be given one.
const NO_LIMIT_M: f64 = 10.0;

/// The rows of a sensor; none where they are not known.
#[derive(Clone, Debug, Default)]
pub(crate) struct RowsOf {
    /// Elevations, degrees.
    pub deg: Vec<f64>,
    /// Heights of the origins of their rays, m; empty where they start at that of the sensor.
    pub heights_m: Vec<f64>,
}

/// The rows of each sensor.
pub(crate) fn rows_of(sensors: &Sensors) -> Vec<RowsOf> {
    let of_pattern = |p: &ScanPattern| RowsOf {
        deg: p.rows_rad.iter().map(|r| f64::from(*r).to_degrees()).collect(),
        heights_m: p.heights_m.iter().map(|m| f64::from(*m)).collect(),
    };
    sensors.patterns.iter().map(of_pattern).collect()
}

/// Gives every finding its effects. `rows` holds the rows of every sensor.
pub(crate) fn fill_effects(findings: &mut [Finding], rig: &Rig, rows: &[RowsOf]) {
    for finding in findings.iter_mut() {
        if finding.effects.is_empty() {
            finding.effects = effects_of(finding, rig, rows);
        }
        // What the simulator would refuse is no effect of it.
        finding.effects.retain(|effect| effect.model().check().is_ok());
    }
}

/// The effects of a finding; none where the sensor model has none for it. Of an ambiguous finding those of its first
/// candidate.
pub(crate) fn effects_of(finding: &Finding, rig: &Rig, rows: &[RowsOf]) -> Vec<Effect> {
    match finding.status {
        Status::Unexplained => tables(finding, rig, rows),
        Status::NotIdentifiable => Vec::new(),
        _ => named(finding, rig, rows),
    }
}

/// The cause whose effect corrects the simulation: the named one, or the first candidate.
pub(crate) fn cause_of(finding: &Finding) -> Cause {
    let first = || finding.candidates.as_ref().and_then(|c| c.first()).copied();
    finding.cause.or_else(first).unwrap_or(Cause::Unexplained)
}

/// A parameter's best value; 0 where the finding does not have it.
fn value(f: &Finding, quantity: Quantity) -> f64 {
    f.parameter(quantity).map_or(0.0, |p| rounded(p.estimate, 7))
}

/// As many places behind the point as a file needs.
pub(crate) fn rounded(v: f64, places: i32) -> f64 {
    let scale = 10f64.powi(places);
    (v * scale).round() / scale
}

/// A negative strength is no effect: the simulation has too much of it.
fn positive(strength: f64, effect: impl Into<Option<Effect>>) -> Vec<Effect> {
    if strength < 0.0 { Vec::new() } else { effect.into().into_iter().collect() }
}

/// The effects of a named cause.
#[expect(clippy::too_many_lines, reason = "a table: one arm for each cause")]
fn named(f: &Finding, rig: &Rig, rows: &[RowsOf]) -> Vec<Effect> {
    let value = |quantity: Quantity| value(f, quantity);
    let effect = match cause_of(f) {
        Cause::RangeNoise => return range_noise(f),
        Cause::SignalNoise => Effect::RangeNoiseBySignal(RangeNoiseBySignal {
            std_m: value(Quantity::StdM),
            exponent: value(Quantity::Exponent),
            signal: USUAL_SIGNAL,
            most_m: NO_LIMIT_M,
            assumed: Some(AssumedReflectivity::even(DIAGNOSIS_REFLECTIVITY)),
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
            let of_sensor = |(sensor, rows, offsets_m): (String, RowsOf, Vec<f64>)| {
                let RowsOf { deg: rows_deg, heights_m } = rows;
                Effect::BeamRangeOffset(BeamRangeOffset { std_m: 0.0, offsets_m, sensor, rows_deg, heights_m })
            };
            return row_tables(f, rig, rows, 4).into_iter().map(of_sensor).collect();
        }
        Cause::BeamElevationOffset => return row_elevations(f, rig, rows),
        Cause::BeamIntensity => {
            let of_sensor = |(sensor, rows, gains_ln): (String, RowsOf, Vec<f64>)| {
                let RowsOf { deg: rows_deg, heights_m } = rows;
                Effect::BeamIntensity(BeamIntensity { std: 0.0, gains_ln, sensor, rows_deg, heights_m })
            };
            return row_tables(f, rig, rows, 4).into_iter().map(of_sensor).collect();
        }
        Cause::Quantisation => Effect::RangeQuantisation(RangeQuantisation { step_m: value(Quantity::StepM) }),
        Cause::AngularJitter => {
            let std_deg = value(Quantity::StdDeg);
            let jitter = AngularJitter { azimuth_std_deg: std_deg, elevation_std_deg: std_deg };
            return positive(std_deg, Effect::AngularJitter(jitter));
        }
        Cause::RangeCut => Effect::RangeLimits(RangeLimits { min_m: 0.0, max_m: value(Quantity::MaxM) }),
        Cause::NearCut => Effect::RangeLimits(RangeLimits { min_m: value(Quantity::MinM), ..RangeLimits::default() }),
        Cause::DirtyWindow => return dirty_window(f, rig).into_iter().collect(),
        Cause::DualReturns if value(Quantity::DivergenceRad) > 0.0 => {
            let beam = BeamDivergence { divergence_rad: value(Quantity::DivergenceRad), ..BeamDivergence::default() };
            return vec![Effect::BeamDivergence(beam), Effect::DualReturns(DualReturns {})];
        }
        Cause::PacketLoss => Effect::PacketLoss(PacketLoss {
            packet_ms: value(Quantity::PacketMs),
            loss: value(Quantity::Loss),
            burst: value(Quantity::Burst),
            outage: 0.0,
        }),
        Cause::CoordinateRounding => Effect::CoordinateRounding(CoordinateRounding { step_m: value(Quantity::StepM) }),
        Cause::SensorExtrinsics => Effect::SensorPoseError(SensorPoseError {
            sensor: sensor_of(f, rig).name.clone(),
            translation_m: [Quantity::ForwardM, Quantity::LeftM, Quantity::UpM].map(value),
            rotation_deg: [Quantity::RollDeg, Quantity::PitchDeg, Quantity::YawDeg].map(value),
        }),
        Cause::PitchRoll => Effect::EgoAttitude(EgoAttitude {
            roll_deg: value(Quantity::RollDeg),
            pitch_deg: value(Quantity::PitchDeg),
            ..EgoAttitude::default()
        }),
        Cause::EgoAttitude => Effect::EgoAttitude(EgoAttitude {
            pitch_at_70mps_deg: value(Quantity::PitchAt70MpsDeg),
            ..EgoAttitude::default()
        }),
        Cause::RollingShutter => return vec![rolling_shutter(f)],
        Cause::MixedPixels => Effect::BeamDivergence(BeamDivergence {
            divergence_rad: value(Quantity::DivergenceRad),
            rays: 7,
            pulse_m: value(Quantity::PulseM),
            pick: Pick::Strongest,
        }),
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
        _ => return Vec::new(),
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

/// Motion distortion, of all that stands still or of labelled objects alone. Its extent is the duration of a scan where
/// the ego motion is known, else the displacement.
fn rolling_shutter(f: &Finding) -> Effect {
    let scan_s = f.parameter(Quantity::ScanS).map(|_| value(f, Quantity::ScanS));
    let slide = [Quantity::ShearXM, Quantity::ShearYM, Quantity::ShearYawDeg].map(|quantity| value(f, quantity));
    let slide = scan_s.is_none().then_some(slide);
    let only_objects = f.channel == Channel::Objects;
    let uneven = value(f, Quantity::Uneven).clamp(-RollingShutter::MOST_UNEVEN, RollingShutter::MOST_UNEVEN);
    Effect::RollingShutter(RollingShutter { deskewed: false, scan_s, uneven, only_objects, slide })
}

/// Name, rows and values of each sensor of which the finding has rows; rows without a value have 0.
fn row_tables(f: &Finding, rig: &Rig, rows: &[RowsOf], places: i32) -> Vec<(String, RowsOf, Vec<f64>)> {
    let of_sensor = |(sensor, rows): (&Sensor, &RowsOf)| {
        let mut values = vec![0.0; rows.deg.len()];
        for (id, p) in &f.parameters {
            match id {
                ParameterId::Row { sensor: of, row } if *of == sensor.name && *row < values.len() => {
                    values[*row] = rounded(p.estimate, places);
                }
                _ => {}
            }
        }
        let rows = RowsOf {
            deg: rows.deg.iter().map(|deg| rounded(*deg, 5)).collect(),
            heights_m: rows.heights_m.iter().map(|m| rounded(*m, 4)).collect(),
        };
        let known = rows.deg.len() > 1 && values.iter().any(|v| *v != 0.0);
        known.then(|| (sensor.name.clone(), rows, values))
    };
    rig.sensors.iter().zip(rows).filter_map(of_sensor).collect()
}

/// Errors of the rows' elevations as tables; for all rows alike where the finding has no rows.
fn row_elevations(f: &Finding, rig: &Rig, rows: &[RowsOf]) -> Vec<Effect> {
    let error = |(sensor, rows, elevations_deg): (String, RowsOf, Vec<f64>)| BeamAngleError {
        elevation_deg: value(f, Quantity::MeanDeg),
        sensor,
        rows_deg: rows.deg,
        heights_m: rows.heights_m,
        elevations_deg,
        ..BeamAngleError::default()
    };
    let tables = row_tables(f, rig, rows, 5);
    let effects: Vec<BeamAngleError> = match tables.is_empty() {
        true => vec![error((String::new(), RowsOf::default(), vec![]))],
        false => tables.into_iter().map(error).collect(),
    };
    effects.into_iter().map(Effect::BeamAngleError).collect()
}

/// The sensor of a finding.
fn sensor_of<'a>(f: &Finding, rig: &'a Rig) -> &'a Sensor {
    &rig.sensors[(value(f, Quantity::Sensor) as usize).min(rig.sensors.len() - 1)]
}

/// A patch of directions that loses more than others: the table over directions is a spot.
fn dirty_window(f: &Finding, rig: &Rig) -> Option<Effect> {
    let sensor = rig.sensors.get(value(f, Quantity::Sensor) as usize)?;
    Some(Effect::DirtyWindow(DirtyWindow {
        sensor: sensor.name.clone(),
        azimuth_deg: value(f, Quantity::AzimuthDeg),
        elevation_deg: value(f, Quantity::ElevationDeg),
        radius_deg: value(f, Quantity::RadiusDeg),
        aspect: value(f, Quantity::Aspect),
        sharpness: value(f, Quantity::Sharpness),
        transmission: TRANSMISSION,
        loss: rounded((value(f, Quantity::Share) / (1.0 - TRANSMISSION * TRANSMISSION)).clamp(0.0, 1.0), 7),
        noise_m: 0.0,
    }))
}

/// An unexplained finding: for each sensor a table along its covariate.
fn tables(f: &Finding, rig: &Rig, rows: &[RowsOf]) -> Vec<Effect> {
    let of_sensor = |(number, sensor): (usize, &Sensor)| {
        let table = table_of_sensor(f, number, rows);
        if table.is_empty() {
            return None;
        }
        let mut effect = Empirical {
            sensor: sensor.name.clone(),
            covariate: match f.covariate {
                Covariate::Row => TableCovariate::ElevationDeg,
                Covariate::Range => TableCovariate::RangeM,
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
fn table_of_sensor(f: &Finding, sensor: usize, rows: &[RowsOf]) -> Vec<[f64; 2]> {
    let usual = f.parameter(Quantity::SimulatedStdM).map_or(0.0, |p| p.estimate.max(0.0));
    let own = f.curve.points.iter().filter(|p| p.sensor == sensor);
    let point = |p: &CurvePoint| {
        let at = if f.covariate == Covariate::Row { *rows.get(sensor)?.deg.get(p.x as usize)? } else { p.x };
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
