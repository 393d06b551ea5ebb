//! What the search of geometry found, in words and numbers.

use super::curve::linear_curve;
use super::floor::{FLOOR_GROUPS, FLOOR_OFFSET_M, FLOOR_SENSOR_M, FLOOR_TURN_RAD};
use super::{Sums, Suspect, fit_all, groups_of, how, split};
use crate::channels::groups::{GroupSums, Grouping, place_of, total};
use crate::channels::mean::Column;
use crate::diagnosis::{Curve, CurvePoint, Minimum, Parameter, Status};
use crate::inference::choice::UNNAMED;
use crate::inference::grouped::{self, GroupFit};
use crate::inference::linear::{LinearFit, LinearFrame, fit};
use crate::search::{Context, Found, Z_STAR, parameter};
use nalgebra::Vector3;
use std::collections::BTreeMap;

#[expect(clippy::too_many_arguments, reason = "the parts of a finding")]
pub(super) fn found(
    context: &Context,
    sums: &Sums,
    estimate: &[usize],
    blocks: &[usize],
    suspect: &Suspect,
    chosen: &[Suspect],
    equals: Vec<String>,
    confidence: f64,
    held_out_gains: Vec<f64>,
) -> Found {
    let mut parameters: Vec<(String, Parameter)> = Vec::new();
    let name = suspect.name();
    let (covariate, says, curve) = match suspect {
        Suspect::Linear { columns, .. } => {
            let fitted = fit_all(sums, estimate, blocks, chosen);
            let others = others_see(sums, estimate, blocks, columns, chosen);
            linear_parameters(context, sums, &fitted, columns, others, name, &mut parameters);
            let sensor = parameters.iter().find(|(n, _)| n == "sensor").map(|(_, p)| p.estimate as usize);
            let numbers = parameters.iter().filter(|(n, _)| n != "sensor");
            let list: Vec<String> = numbers.map(|(n, p)| format!("{n} {:.4} {}", p.estimate, p.unit)).collect();
            let seen_by = sensor.map_or("lidar", |s| context.rig.sensors[s].name.as_str());
            let displaced = format!("sensor {seen_by} sees the scene displaced: it is mounted otherwise than believed");
            let what = match name {
                "range_bias" => "all ranges are measured longer (shorter where negative) than they are",
                "pitch_roll" => "the whole scene is tilted: the car leans otherwise than the simulation believes",
                "rolling_shutter" => {
                    "the scene shears over a scan: points of a moving car are put where the car is at one moment"
                }
                _ => displaced.as_str(),
            };
            let covariate = match name {
                "range_bias" => "cos_incidence",
                "rolling_shutter" => "scan_phase",
                "pitch_roll" => "range_m",
                _ => "sensor",
            };
            let curve = linear_curve(context, sums, estimate, &fitted, columns, name);
            (covariate.to_owned(), format!("{what}: {}", list.join(", ")), curve)
        }
        Suspect::Groups { grouping, column, .. } => {
            let frames = groups_of(sums, *grouping);
            let all = total(estimate.iter().map(|&i| &frames[i]));
            let (std, n) = match grouping {
                Grouping::Row => grouped::spread_of_rows(&all, how(*column)),
                Grouping::Azimuth => grouped::spread(&all, how(*column), 0.0),
            };
            let error = std / (2.0 * n.max(1.0)).sqrt();
            let unit = if *column == 0 { (1.0, "m") } else { (1f64.to_degrees(), "deg") };
            if name != UNNAMED {
                let label = if *column == 0 { "std_m" } else { "std_deg" };
                parameters.push(parameter(label, std * unit.0, (error.hypot(0.05 * std)) * unit.0, unit.1));
            }
            // Rows that are hardly known are as far off as the others are.
            let least = FLOOR_GROUPS[if *grouping == Grouping::Row { *column } else { 2 }];
            let precision = std.max(least).powi(-2).max(how(*column).precision);
            let fit = GroupFit { precision, ..how(*column) };
            let offsets = grouped::offsets(&all, fit);
            if name != UNNAMED {
                for (k, v) in &offsets {
                    let (sensor, row) = place_of(*k as usize, *grouping);
                    let e = 1.0 / (all[k].gram[2 * column] + fit.precision).sqrt();
                    let label = format!("{}/{}", context.rig.sensors[sensor].name, row as usize);
                    parameters.push(parameter(&label, v * unit.0, e * unit.0, unit.1));
                }
            }
            let curve = group_curve(&all, &offsets, *grouping, fit, unit.0);
            match (grouping, column) {
                (Grouping::Row, 0) => (
                    "row".to_owned(),
                    format!("each row has a range offset of its own: {:.1} cm from row to row", std * 100.0),
                    curve,
                ),
                (Grouping::Row, _) => (
                    "row".into(),
                    format!("each row aims otherwise than believed: by {:.3} degrees from row to row", std * unit.0),
                    curve,
                ),
                _ => (
                    "azimuth".into(),
                    format!(
                        "ranges are off by {:.1} cm in a way that depends on the azimuth; no cause of the catalogue does that",
                        std * 100.0
                    ),
                    curve,
                ),
            }
        }
    };
    let status = match (name, equals.is_empty()) {
        (UNNAMED, _) => Status::Unexplained,
        (_, true) => Status::Named,
        _ => Status::Ambiguous,
    };
    let mut causes: Vec<String> =
        std::iter::once(name.to_owned()).chain(equals.into_iter().filter(|e| e != UNNAMED)).collect();
    let status = if status == Status::Ambiguous && causes.len() == 1 { Status::Named } else { status };
    if name == UNNAMED {
        causes.clear();
    }
    let separate_by = (status == Status::Ambiguous)
        .then(|| "surfaces on all sides at many ranges, and a second sensor that sees the same ones".to_owned());
    let family = match name {
        "range_bias" | "beam_range_offset" => "range_error",
        "rolling_shutter" => "timing",
        UNNAMED => "unknown",
        _ => "geometry",
    };
    Found {
        status,
        causes,
        family,
        parameters,
        confidence,
        channel: "residuals",
        covariate,
        held_out_gains,
        says,
        separate_by,
        curve,
    }
}

/// By how much sensors that are mounted well would be said to be mounted otherwise, beyond chance: what the form of a sensor's pose is wrong by
/// (turns, then shifts). Nothing where fewer than two others are there.
fn others_see(sums: &Sums, estimate: &[usize], blocks: &[usize], columns: &[usize], chosen: &[Suspect]) -> [f64; 6] {
    let pose = |c: usize| if let Column::SensorPose(s, k) = sums.columns[c] { Some((s, k)) } else { None };
    let spoken = split(chosen).0;
    let displaced: Vec<usize> = spoken.iter().filter_map(|c| Some(pose(*c)?.0)).collect();
    let others: Vec<usize> = (0..sums.poses.first().map_or(0, Vec::len)).filter(|s| !displaced.contains(s)).collect();
    // The numbers that the finding has.
    let numbers: Vec<usize> = columns.iter().filter_map(|c| Some(pose(*c)?.1)).collect();
    if others.len() < 2 || numbers.is_empty() {
        return [0.0; 6];
    }
    let frames: Vec<&LinearFrame> = estimate.iter().map(|&i| &sums.linear[i]).collect();
    let mut squares = [0.0; 6];
    for other in &others {
        let of_other = |c: usize| pose(c).filter(|(s, k)| s == other && numbers.contains(k));
        let own = (0..sums.columns.len()).filter(|c| of_other(*c).is_some());
        let with: Vec<usize> = sums.base.iter().chain(&spoken).copied().chain(own).collect();
        let fitted = fit(&frames, blocks, &with, &sums.precision);
        for (at, (_, k)) in with.iter().enumerate().filter_map(|(at, c)| Some((at, of_other(*c)?))) {
            squares[k] += (fitted.theta[at].powi(2) - fitted.error(at).powi(2)).max(0.0);
        }
    }
    // One of them is held against the other others, the finding against all of them.
    let n = others.len() as f64;
    squares.map(|s| ((n * n - 1.0) / (n * n) * s / n).sqrt())
}

fn linear_parameters(
    context: &Context,
    sums: &Sums,
    fitted: &LinearFit,
    columns: &[usize],
    others_see: [f64; 6],
    name: &str,
    parameters: &mut Vec<(String, Parameter)>,
) {
    let value = |c: usize| {
        let i = fitted.columns.iter().position(|x| *x == c)?;
        Some((fitted.theta[i], fitted.error(i)))
    };
    let deg = f64::to_degrees;
    let [mut turn, mut turn_error, mut shift, mut shift_error] = [Vector3::<f64>::zeros(); 4];
    let mut sensor = None;
    for &c in columns {
        let Some((theta, error)) = value(c) else { continue };
        match sums.columns[c] {
            Column::RangeOffset => parameters.push(parameter("offset_m", theta, error.hypot(0.003), "m")),
            Column::RangeScale => parameters.push(parameter("scale", theta, error.hypot(1e-4), "1")),
            Column::Sweep(k) => {
                let (label, unit) = [("shear_x_m", "m"), ("shear_y_m", "m"), ("shear_yaw_deg", "deg")][k];
                let by = if k == 2 { deg(1.0) } else { 1.0 };
                parameters.push(parameter(label, by * theta, by * error, unit));
            }
            // The scene turns and moves against the car: the car leans the other way.
            Column::Pose(k) | Column::SensorPose(_, k) => {
                if let Column::SensorPose(s, _) = sums.columns[c] {
                    sensor = Some(s);
                }
                let error = error.hypot(others_see[k]);
                if k < 3 {
                    (turn[k], turn_error[k]) = (-theta, error);
                } else {
                    (shift[k - 3], shift_error[k - 3]) = (-theta, error.hypot(0.003));
                }
            }
            Column::Structure(_) => {}
        }
    }
    if turn == Vector3::zeros() && shift == Vector3::zeros() {
        return;
    }
    if name == "sensor_extrinsics" {
        let s = sensor.unwrap_or(0);
        parameters
            .push(("sensor".into(), Parameter { estimate: s as f64, unit: "number".into(), ci95: [s as f64; 2] }));
        // In the sensor's own frame, as the effect of the simulator has them.
        let turn_of = context.rig.sensors[s].pose().rotation;
        let matrix = turn_of.inverse().to_rotation_matrix();
        let error_of = |e: Vector3<f64>| {
            Vector3::from_fn(|i, _| (0..3).map(|j| (matrix[(i, j)] * e[j]).powi(2)).sum::<f64>().sqrt())
        };
        (turn, shift) = (turn_of.inverse_transform_vector(&turn), turn_of.inverse_transform_vector(&shift));
        (turn_error, shift_error) = (error_of(turn_error), error_of(shift_error));
    }
    // The free pose of every frame and the free offsets of its surfaces take a part of what a single sensor's turn does.
    let form = if sensor.is_some() { 0.07 } else { 0.03 };
    for (k, label) in ["roll_deg", "pitch_deg", "yaw_deg"].into_iter().enumerate() {
        if turn[k].abs() > 1e-9 {
            let value = deg(turn[k]);
            parameters.push(parameter(label, value, deg(turn_error[k]).hypot(0.002).hypot(form * value), "deg"));
        }
    }
    for (k, label) in ["forward_m", "left_m", "up_m"].into_iter().enumerate() {
        if shift[k].abs() > 1e-9 {
            parameters.push(parameter(label, shift[k], shift_error[k], "m"));
        }
    }
}

fn group_curve(
    sums: &BTreeMap<u32, GroupSums>,
    offsets: &BTreeMap<u32, f64>,
    grouping: Grouping,
    fit: GroupFit,
    unit: f64,
) -> Curve {
    let points = offsets.iter().map(|(k, v)| {
        let (sensor, place) = place_of(*k as usize, grouping);
        let x = if grouping == Grouping::Row {
            place + 1000.0 * sensor as f64
        } else {
            place.to_degrees() + 1000.0 * sensor as f64
        };
        let error = 1.0 / (sums[k].gram[2 * fit.column] + fit.precision).sqrt();
        CurvePoint { x, measured: v * unit, before: 0.0, after: v * unit, error: error * unit }
    });
    let x = if grouping == Grouping::Row { "row (1000 a sensor)" } else { "azimuth, degrees (1000 a sensor)" };
    let y = if fit.column == 0 { "offset of range, m" } else { "offset of elevation, degrees" };
    Curve { x: x.into(), y: y.into(), points: points.collect() }
}

/// Smallest effects that would have been seen.
pub(super) fn minimum(sums: &Sums, select: &[usize], blocks: &[usize]) -> Vec<(String, Minimum)> {
    let frames: Vec<&LinearFrame> = select.iter().map(|&i| &sums.linear[i]).collect();
    let error = |c: Column| {
        let k = sums.columns.iter().position(|x| *x == c)?;
        let with: Vec<usize> = sums.base.iter().copied().chain([k]).collect();
        Some(fit(&frames, blocks, &with, &sums.precision).error(sums.base.len()))
    };
    let mut all = Vec::new();
    let mut push = |name: &str, parameter: &str, value: Option<f64>, floor: f64, unit: &str, factor: f64| {
        if let Some(v) = value {
            let minimum =
                Minimum { parameter: parameter.into(), value: factor * (Z_STAR * v).max(floor), unit: unit.into() };
            all.push((name.to_owned(), minimum));
        }
    };
    let deg = 1f64.to_degrees();
    push("range_bias", "offset_m", error(Column::RangeOffset), FLOOR_OFFSET_M, "m", 1.0);
    push("pitch_roll", "pitch_deg", error(Column::Pose(1)), FLOOR_TURN_RAD, "deg", deg);
    let one = if sums.columns.contains(&Column::SensorPose(0, 2)) { Column::SensorPose(0, 2) } else { Column::Pose(2) };
    let of_one = sums.columns.iter().position(|x| *x == one).filter(|_| one != Column::Pose(2));
    let displaced_m = of_one.map(|k| sums.displaced_m(select, 0, &[(k, 1.0)]));
    let floor = displaced_m.map_or(FLOOR_TURN_RAD, |by_one_rad| FLOOR_SENSOR_M / by_one_rad.max(1e-3));
    push("sensor_extrinsics", "yaw_deg", error(one), floor, "deg", deg);
    push("beam_range_offset", "std_m", Some(0.0), FLOOR_GROUPS[0], "m", 1.0);
    push("beam_elevation_offset", "std_deg", Some(0.0), FLOOR_GROUPS[1], "deg", deg);
    all
}
