//! Findings of geometry: parameters, sentences and plots.

use super::beside_rows;
use super::curve::linear_curve;
use super::floor::{FLOOR_GROUPS, FLOOR_SWEEP, is_attitude_alone};
use super::hypotheses::{Hypothesis, is_attitude};
use super::reported::fit_of;
use super::steadiness::come_with_time;
use super::sums::{Sums, group_fit, row_columns, split};
use super::{Search, Selected};
use crate::catalogue::sizes::{DISPLACED_M, RANGE_OFFSET_M, TURN_RAD};
use crate::catalogue::{Cause, Channel, Covariate, ParameterId, Quantity, Unit};
use crate::channels::groups::{Group, Grouping, total};
use crate::channels::mean::Column;
use crate::channels::moments::{final_share, lean_at};
use crate::channels::motion::OwnMotion;
use crate::curve::{Curve, CurvePoint};
use crate::diagnosis::{Minimum, Status};
use crate::effects::rounded;
use crate::inference::grouped::{self, GroupFit};
use crate::inference::linear::{LinearFit, LinearFrame, fit};
use crate::search::rolling_shutter::Extent;
use crate::search::{Found, NamedParameter, Z_STAR, parameter, sensor_number, with_error};
use nalgebra::Vector3;
use sensor::effects::RangeDrift;
use sensor::{Effect, Rig};
use std::collections::BTreeMap;

/// What is said of one hypothesis.
struct Description {
    covariate: Covariate,
    says: String,
    curve: Curve,
    parameters: Vec<NamedParameter>,
}

/// The finding of one of the chosen hypotheses.
pub(super) fn found(
    search: &Search,
    hypothesis: &Hypothesis,
    chosen: &[Hypothesis],
    selected: Selected,
    held_out_gains: Vec<f64>,
) -> Found {
    let comes_with_time = row_columns(std::slice::from_ref(hypothesis))
        .first()
        .is_some_and(|column| come_with_time(search, *column, chosen));
    let cause = if comes_with_time { Cause::Unexplained } else { hypothesis.cause() };
    let Description { covariate, says, curve, parameters } = match hypothesis {
        Hypothesis::Linear { cause, columns } => linear(search, *cause, columns, chosen),
        Hypothesis::Groups { grouping, column, .. } => groups(search, cause, *grouping, *column, chosen),
    };
    let named = cause != Cause::Unexplained;
    let mut rivals = selected.rivals;
    let may_lean = is_attitude_alone(&search.sums, &fit_of(search, chosen), hypothesis);
    if may_lean && !rivals.contains(&Cause::PitchRoll) && !chosen.iter().any(is_attitude) {
        rivals.push(Cause::PitchRoll);
    }
    rivals.retain(|r| named && *r != Cause::Unexplained);
    let causes: Vec<Cause> = std::iter::once(cause).filter(|_| named).chain(rivals).collect();
    let status = match causes.len() {
        0 => Status::Unexplained,
        1 => Status::Named,
        _ => Status::Ambiguous,
    };
    let separate_by = (status == Status::Ambiguous)
        .then(|| "surfaces on all sides at many ranges, and a second sensor that sees the same ones".to_owned());
    Found {
        effects: drift(&search.sums, hypothesis.columns(), &parameters).into_iter().collect(),
        status,
        causes,
        parameters,
        confidence: selected.confidence,
        channel: Channel::Residuals,
        covariate,
        held_out_gains,
        says,
        separate_by,
        curve,
    }
}

/// The effect of a drift, whose course is no parameter of its finding.
fn drift(sums: &Sums, columns: &[usize], parameters: &[NamedParameter]) -> Option<Effect> {
    let of = |c: &usize| if let Column::Drift(k) = sums.columns[*c] { Some(k) } else { None };
    let course = columns.iter().find_map(of)?;
    let (_, drift) = parameters.iter().find(|(id, _)| *id == ParameterId::Of(Quantity::DriftM))?;
    Some(Effect::RangeDrift(RangeDrift {
        drift_m: rounded(drift.estimate * final_share(course), 5),
        time_constant_s: rounded(sums.moments.time_constant_s(course), 3),
    }))
}

/// Describes a linear hypothesis.
fn linear(search: &Search, cause: Cause, columns: &[usize], chosen: &[Hypothesis]) -> Description {
    let (sums, rig) = (&search.sums, search.context.rig);
    let fitted = fit_of(search, chosen);
    let spurious = spurious_poses(search, columns, chosen);
    let parameters = linear_parameters(sums, rig, &fitted, columns, spurious, cause);
    let is_sensor = |id: &ParameterId| *id == ParameterId::Of(Quantity::Sensor);
    let sensor = parameters.iter().find(|(id, _)| is_sensor(id)).map(|(_, p)| p.estimate as usize);
    let numbers = parameters.iter().filter(|(id, _)| !is_sensor(id));
    let list: Vec<String> = numbers.map(|(id, p)| format!("{id} {:.4} {}", p.estimate, p.unit)).collect();
    let seen_by = sensor.map_or("lidar", |s| rig.sensors[s].name.as_str());
    if columns.iter().any(|c| sums.columns[*c] == Column::Scan) {
        let of = |column: Column| sums.fitted(&fitted, column).unwrap_or_default();
        let driving: Vec<OwnMotion> = sums.moments.of_frames.iter().map(|moment| moment.own).collect();
        let extent = Extent::of_duration([Column::Scan, Column::Uneven].map(of), &driving);
        return Description {
            covariate: Covariate::ScanPhase,
            says: extent.says(),
            curve: linear_curve(search, &fitted, columns, cause),
            parameters: extent.parameters(),
        };
    }
    let displaced = format!("sensor {seen_by} sees the scene displaced: it is mounted otherwise than believed");
    let (covariate, what) = match cause {
        Cause::RangeBias => {
            (Covariate::CosIncidence, "all ranges are measured longer (shorter where negative) than they are")
        }
        Cause::RangeDrift => (Covariate::Time, "all ranges grow longer (shorter where negative) over the recording"),
        Cause::EgoAttitude => (
            Covariate::Velocity,
            "the whole scene is tilted, the more the faster the car drives: it pitches otherwise than simulated",
        ),
        Cause::PitchRoll => {
            (Covariate::Range, "the whole scene is tilted: the car leans otherwise than the simulation believes")
        }
        Cause::RollingShutter => (
            Covariate::ScanPhase,
            "the scene shears over a scan: points of a moving car are put where the car is at one moment",
        ),
        _ => (Covariate::Sensor, displaced.as_str()),
    };
    Description {
        covariate,
        says: format!("{what}: {}", list.join(", ")),
        curve: linear_curve(search, &fitted, columns, cause),
        parameters,
    }
}

/// Describes offsets of groups of rays, of rows together with what else was chosen.
fn groups(search: &Search, cause: Cause, grouping: Grouping, column: usize, chosen: &[Hypothesis]) -> Description {
    let ((std, n), mut offsets) = match grouping {
        Grouping::Row => beside_rows::rows(search, column, chosen),
        Grouping::Azimuth | Grouping::Range => strips(search, grouping, column),
    };
    let error = std / (2.0 * n.max(1.0)).sqrt();
    // The mean offset of all rows is theirs unless a bias of all ranges was found. It is fitted together with offsets
    // of the surfaces, which would take it up.
    let biased = chosen.iter().any(|h| h.cause() == Cause::RangeBias);
    if column == 0 && grouping == Grouping::Row && !biased {
        let mean_m = mean_offset_m(search);
        offsets.values_mut().for_each(|[v, _]| *v += mean_m);
    }
    let (scale, unit) = if column == 0 { (1.0, Unit::Metre) } else { (1f64.to_degrees(), Unit::Degree) };
    let mut parameters: Vec<NamedParameter> = Vec::new();
    if cause != Cause::Unexplained {
        let spread = if column == 0 { Quantity::StdM } else { Quantity::StdDeg };
        parameters.push(parameter(spread, std * scale, (error.hypot(0.05 * std)) * scale));
        parameters.extend(offsets.iter().map(|(group, [v, variance])| {
            let sensor = search.context.rig.sensors[usize::from(group.sensor)].name.clone();
            let id = ParameterId::Row { sensor, row: usize::from(group.index) };
            (id, with_error(v * scale, variance.sqrt() * scale, unit))
        }));
    }
    let spread = if column == 0 { format!("{:.1} cm", std * 100.0) } else { format!("{:.3} degrees", std * scale) };
    let says = match (grouping, column) {
        (Grouping::Row, _) if cause == Cause::Unexplained => {
            format!(
                "offsets of rows grow over the recording: {spread} from row to row; no cause of the catalogue does that"
            )
        }
        (Grouping::Row, 0) => format!("each row has a range offset of its own: {spread} from row to row"),
        (Grouping::Row, _) => format!("each row aims otherwise than believed: by {spread} from row to row"),
        _ => format!(
            "ranges are off by {spread} in a way that depends on the {}; no cause of the catalogue does that",
            if grouping == Grouping::Range { "range" } else { "azimuth" }
        ),
    };
    Description { covariate: grouping.into(), says, curve: group_curve(&offsets, grouping, column, scale), parameters }
}

/// Spread of the offsets of strips of azimuth, or steps of range, with the number of those that are known well; the
/// offsets with their variances.
fn strips(search: &Search, grouping: Grouping, column: usize) -> ((f64, f64), BTreeMap<Group, [f64; 2]>) {
    let frames = search.sums.groups_of(grouping);
    let all = total(search.estimate.iter().map(|&i| &frames[i]));
    let spread = grouped::spread(&all, group_fit(column), 0.0);
    // The prior of strips with few returns is the spread of the others.
    let precision = spread.0.max(FLOOR_GROUPS[2]).powi(-2).max(group_fit(column).precision);
    let offsets = grouped::offsets(&all, GroupFit { precision, ..group_fit(column) });
    let with_variance = |(g, offset)| (g, [offset, 1.0 / (all[&g].gram[2 * column] + precision)]);
    (spread, offsets.into_iter().map(with_variance).collect())
}

/// Offset of all ranges, m; 0 where it is not known to three standard errors.
fn mean_offset_m(search: &Search) -> f64 {
    let Some(k) = search.sums.columns.iter().position(|c| *c == Column::RangeOffset) else { return 0.0 };
    let frames: Vec<&LinearFrame> = search.estimate.iter().map(|&i| &search.sums.linear[i]).collect();
    let with: Vec<usize> = search.sums.base.iter().copied().chain([k]).collect();
    let fitted = fit(&frames, &search.estimate_blocks, &with, &search.sums.precision);
    let (mean_m, error) = (fitted.theta[with.len() - 1], fitted.error(with.len() - 1));
    if mean_m.abs() > 3.0 * error { mean_m } else { 0.0 }
}

/// Pose errors that the same fit attributes to sensors that are mounted correctly, beyond chance: three turns, rad,
/// then three shifts, m, root mean square over the other sensors. They measure the error of the model of a sensor's
/// pose. Zero where fewer than two others are there.
fn spurious_poses(search: &Search, columns: &[usize], chosen: &[Hypothesis]) -> [f64; 6] {
    let sums = &search.sums;
    let pose = |c: usize| if let Column::SensorPose(s, k) = sums.columns[c] { Some((s, k)) } else { None };
    let fitted_columns = split(chosen).0;
    let displaced: Vec<usize> = fitted_columns.iter().filter_map(|c| Some(pose(*c)?.0)).collect();
    let others: Vec<usize> = (0..sums.poses.first().map_or(0, Vec::len)).filter(|s| !displaced.contains(s)).collect();
    // The same numbers as those of the finding.
    let numbers: Vec<usize> = columns.iter().filter_map(|c| Some(pose(*c)?.1)).collect();
    if others.len() < 2 || numbers.is_empty() {
        return [0.0; 6];
    }
    let frames: Vec<&LinearFrame> = search.estimate.iter().map(|&i| &sums.linear[i]).collect();
    let mut squares = [0.0; 6];
    for other in &others {
        let of_other = |c: usize| pose(c).filter(|(s, k)| s == other && numbers.contains(k));
        let own = (0..sums.columns.len()).filter(|c| of_other(*c).is_some());
        let with: Vec<usize> = sums.base.iter().chain(&fitted_columns).copied().chain(own).collect();
        let fitted = fit(&frames, &search.estimate_blocks, &with, &sums.precision);
        for (at, (_, k)) in with.iter().enumerate().filter_map(|(at, c)| Some((at, of_other(*c)?))) {
            squares[k] += (fitted.theta[at].powi(2) - fitted.error(at).powi(2)).max(0.0);
        }
    }
    // Each of them is compared with the other others, the finding with all of them.
    let n = others.len() as f64;
    squares.map(|s| ((n * n - 1.0) / (n * n) * s / n).sqrt())
}

/// Turn and shift of the ego vehicle or of a sensor, with their errors, rad and m.
struct Pose {
    turn: Vector3<f64>,
    turn_error: Vector3<f64>,
    shift: Vector3<f64>,
    shift_error: Vector3<f64>,
    /// The sensor, where it is that of one sensor.
    sensor: Option<usize>,
}

/// Parameters of a linear hypothesis.
fn linear_parameters(
    sums: &Sums,
    rig: &Rig,
    fitted: &LinearFit,
    columns: &[usize],
    spurious: [f64; 6],
    cause: Cause,
) -> Vec<NamedParameter> {
    let value = |c: usize| {
        let i = fitted.columns.iter().position(|x| *x == c)?;
        Some((fitted.theta[i], fitted.error(i)))
    };
    let mut parameters = Vec::new();
    let [mut turn, mut turn_error, mut shift, mut shift_error] = [Vector3::<f64>::zeros(); 4];
    let mut sensor = None;
    for &c in columns {
        let Some((theta, error)) = value(c) else { continue };
        match sums.columns[c] {
            Column::RangeOffset => parameters.push(parameter(Quantity::OffsetM, theta, error.hypot(0.003))),
            Column::RangeScale => parameters.push(parameter(Quantity::Scale, theta, error.hypot(1e-4))),
            Column::Drift(_) => parameters.push(parameter(Quantity::DriftM, theta, error.hypot(0.003))),
            Column::Lean => {
                let by = -theta.to_degrees() * lean_at(70.0);
                let error = error.to_degrees() * lean_at(70.0);
                parameters.push(parameter(Quantity::PitchAt70MpsDeg, by, error.hypot(FORM_OF_POSE * by)));
            }
            Column::Sweep(k) => {
                let shear = [Quantity::ShearXM, Quantity::ShearYM, Quantity::ShearYawDeg][k];
                let by = if k == 2 { 1f64.to_degrees() } else { 1.0 };
                parameters.push(parameter(shear, by * theta, by * error));
            }
            // The scene turns and moves against the vehicle: the vehicle moves the other way.
            Column::Pose(k) | Column::SensorPose(_, k) => {
                if let Column::SensorPose(s, _) = sums.columns[c] {
                    sensor = Some(s);
                }
                let error = error.hypot(spurious[k]);
                if k < 3 {
                    (turn[k], turn_error[k]) = (-theta, error);
                } else {
                    (shift[k - 3], shift_error[k - 3]) = (-theta, error.hypot(0.003));
                }
            }
            Column::Scan | Column::Uneven | Column::Structure(_) => {}
        }
    }
    parameters.extend(pose_parameters(rig, Pose { turn, turn_error, shift, shift_error, sensor }, cause));
    parameters
}

/// Relative error of the model of a turn of the whole scene: poses of frames absorb a part of it.
const FORM_OF_POSE: f64 = 0.03;

/// Parameters of a pose; none where it has no turn and no shift.
fn pose_parameters(rig: &Rig, pose: Pose, cause: Cause) -> Vec<NamedParameter> {
    let Pose { mut turn, mut turn_error, mut shift, mut shift_error, sensor } = pose;
    let mut parameters = Vec::new();
    if turn == Vector3::zeros() && shift == Vector3::zeros() {
        return parameters;
    }
    if cause == Cause::SensorExtrinsics {
        let s = sensor.unwrap_or(0);
        parameters.push(sensor_number(s));
        // In the sensor's own frame, as the effect of the simulator has them.
        let turn_of = rig.sensors[s].pose().rotation;
        let matrix = turn_of.inverse().to_rotation_matrix();
        let error_of = |e: Vector3<f64>| {
            Vector3::from_fn(|i, _| (0..3).map(|j| (matrix[(i, j)] * e[j]).powi(2)).sum::<f64>().sqrt())
        };
        (turn, shift) = (turn_of.inverse_transform_vector(&turn), turn_of.inverse_transform_vector(&shift));
        (turn_error, shift_error) = (error_of(turn_error), error_of(shift_error));
    }
    let deg = f64::to_degrees;
    // Relative error of the model: poses of frames and offsets of surfaces absorb a part of the turn of a single
    // sensor.
    let form = if sensor.is_some() { 0.07 } else { FORM_OF_POSE };
    for (k, angle) in [Quantity::RollDeg, Quantity::PitchDeg, Quantity::YawDeg].into_iter().enumerate() {
        if turn[k].abs() > 1e-9 {
            let value = deg(turn[k]);
            parameters.push(parameter(angle, value, deg(turn_error[k]).hypot(0.002).hypot(form * value)));
        }
    }
    for (k, length) in [Quantity::ForwardM, Quantity::LeftM, Quantity::UpM].into_iter().enumerate() {
        if shift[k].abs() > 1e-9 {
            parameters.push(parameter(length, shift[k], shift_error[k]));
        }
    }
    parameters
}

/// Offsets of groups, with their variances, along their rows or azimuths, a curve for each sensor.
fn group_curve(offsets: &BTreeMap<Group, [f64; 2]>, grouping: Grouping, column: usize, scale: f64) -> Curve {
    let points = offsets.iter().map(|(group, [v, variance])| {
        let place = group.place(grouping);
        let x = if grouping == Grouping::Azimuth { place.to_degrees() } else { place };
        let sensor = usize::from(group.sensor);
        let error = variance.sqrt() * scale;
        CurvePoint { sensor, x, measured: v * scale, before: 0.0, after: v * scale, error }
    });
    let x = match grouping {
        Grouping::Row => "row",
        Grouping::Azimuth => "azimuth, degrees",
        Grouping::Range => "range, m",
    };
    let y = if column == 0 { "offset of range, m" } else { "offset of elevation, degrees" };
    Curve { x: x.into(), y: y.into(), by_sensor: true, points: points.collect() }
}

/// Detectable effect sizes.
pub(super) fn minimum(sums: &Sums, select: &[usize], blocks: &[usize]) -> Vec<(Cause, Minimum)> {
    let frames: Vec<&LinearFrame> = select.iter().map(|&i| &sums.linear[i]).collect();
    let error = |c: Column| {
        let k = sums.columns.iter().position(|x| *x == c)?;
        let with: Vec<usize> = sums.base.iter().copied().chain([k]).collect();
        Some(fit(&frames, blocks, &with, &sums.precision).error(sums.base.len()))
    };
    // The size of an effect of one column that displaces surfaces by as much as is reported.
    let displacing = |c: Column| {
        let sensor = if let Column::SensorPose(sensor, _) = c { Some(sensor) } else { None };
        let k = sums.columns.iter().position(|x| *x == c);
        k.map_or(0.0, |k| DISPLACED_M / sums.displaced_m(select, sensor, &[(k, 1.0)], &sums.base).max(1e-3))
    };
    let mut all = Vec::new();
    let mut push = |cause: Cause, quantity: Quantity, value: Option<f64>, floor: f64, factor: f64| {
        if let Some(v) = value {
            all.push((cause, Minimum::new(quantity, factor * (Z_STAR * v).max(floor))));
        }
    };
    let deg = 1f64.to_degrees();
    let [offset, pitch] = [Column::RangeOffset, Column::Pose(1)];
    push(Cause::RangeBias, Quantity::OffsetM, error(offset), displacing(offset).max(RANGE_OFFSET_M), 1.0);
    let drift = Column::Drift(1);
    push(Cause::RangeDrift, Quantity::DriftM, error(drift), displacing(drift).max(RANGE_OFFSET_M), 1.0);
    let least_lean = TURN_RAD / sums.moments.most_lean().max(1e-9);
    let lean = displacing(Column::Lean).max(least_lean);
    push(Cause::EgoAttitude, Quantity::PitchAt70MpsDeg, error(Column::Lean), lean, deg * lean_at(70.0));
    push(Cause::PitchRoll, Quantity::PitchDeg, error(pitch), displacing(pitch).max(TURN_RAD), deg);
    let one = if sums.columns.contains(&Column::SensorPose(0, 2)) { Column::SensorPose(0, 2) } else { Column::Pose(2) };
    // The pose of one of several sensors has no other smallest size.
    let least = if one == Column::Pose(2) { TURN_RAD } else { 0.0 };
    push(Cause::SensorExtrinsics, Quantity::YawDeg, error(one), displacing(one).max(least), deg);
    let ahead = Column::Sweep(0);
    push(Cause::RollingShutter, Quantity::ShearXM, error(ahead), displacing(ahead).max(FLOOR_SWEEP[0]), 1.0);
    push(Cause::BeamRangeOffset, Quantity::StdM, Some(0.0), FLOOR_GROUPS[0], 1.0);
    push(Cause::BeamElevationOffset, Quantity::StdDeg, Some(0.0), FLOOR_GROUPS[1], deg);
    all
}
