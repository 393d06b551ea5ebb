//! What the search of labels and objects found, in words and numbers.

use super::{CANDIDATES, CAUSES, Cause, Row, Side, TARGETS_CLOCK};
use crate::diagnosis::{Curve, CurvePoint, Status};
use crate::inference::linear::LinearFit;
use crate::search::{Found, parameter};

#[expect(clippy::too_many_arguments, reason = "the parts of a finding")]
pub(super) fn found(
    candidate: usize,
    fitted: &LinearFit,
    own: std::ops::Range<usize>,
    equals: Vec<String>,
    confidence: f64,
    held_out_gains: Vec<f64>,
    side: Side,
    rows: &[Row],
    usable: &[bool],
    late_by: [f64; 2],
) -> Found {
    let (name, columns) = CANDIDATES[candidate];
    // Labels that stand ahead of the returns are the same as returns that stand behind the labels.
    let sign = if side == Side::Labels { 1.0 } else { -1.0 };
    let mut parameters = Vec::new();
    let mut words = Vec::new();
    for (i, &c) in own.clone().zip(columns) {
        let (mut theta, mut error) = (fitted.theta[i], fitted.error(i));
        if columns == TARGETS_CLOCK && c == 3 {
            // From frame to frame the own speed changes as well; among the objects of a frame it does not.
            [theta, error] = late_by;
        }
        match CAUSES[c] {
            Cause::Forward if name == "time_offset" => continue,
            Cause::Forward => parameters.push(parameter("forward_m", sign * theta, error, "m")),
            Cause::Left => parameters.push(parameter("left_m", sign * theta, error, "m")),
            Cause::Up if name == "wrong_shape" => parameters.push(parameter("higher_m", theta, error, "m")),
            Cause::Up => parameters.push(parameter("up_m", sign * theta, error, "m")),
            Cause::SeenVelocity | Cause::Velocity => {
                parameters.push(parameter("offset_s", -sign * theta, error.hypot(0.02 * theta), "s"))
            }
            Cause::Longer => parameters.push(parameter("longer_m", 2.0 * theta, 2.0 * error, "m")),
            Cause::Wider => parameters.push(parameter("wider_m", 2.0 * theta, 2.0 * error, "m")),
            Cause::Swept => parameters.push(parameter("scan_s", -theta, error.hypot(0.05 * theta), "s")),
        }
        words.push(format!(
            "{} {:+.3} {}",
            parameters[parameters.len() - 1].0,
            parameters[parameters.len() - 1].1.estimate,
            parameters[parameters.len() - 1].1.unit
        ));
    }
    let what = if side == Side::Labels {
        "measured labels stand beside the simulated ones, the returns do not"
    } else {
        "measured objects stand beside the simulated ones"
    };
    let clock = match columns {
        [3] => "; they move with the velocity that the sensor sees: all positions against the cloud",
        [4] | TARGETS_CLOCK => "; they move with the targets' velocity over the ground: the targets' clock",
        _ => "",
    };
    let says = format!("{what}: {}{clock}", words.join(", "));
    let (covariate, x_column) = match columns {
        [3] => ("seen_velocity_m_s", 3),
        [4] => ("velocity_m_s", 4),
        TARGETS_CLOCK => ("velocity_m_s", 3),
        [7] => ("scan_phase * velocity", 7),
        [5, ..] | [6] => ("side_seen", columns[0]),
        _ => ("none", if usable[4] { 4 } else { 3 }),
    };
    let status = if equals.is_empty() { Status::Named } else { Status::Ambiguous };
    let separate_by = (!equals.is_empty()).then(|| {
        let frames = if usable[3] { "" } else { "frames that follow one another, so that speeds are known, and " };
        format!("{frames}targets at very different speeds: a constant offset does not change with speed, a late clock's does")
    });
    let axis = match columns {
        [1] | [6] => 1,
        [2] => 2,
        _ => 0,
    };
    let family = match name {
        "time_offset" | "rolling_shutter" => "timing",
        "wrong_shape" => "geometry",
        _ => "labels",
    };
    Found {
        status,
        causes: std::iter::once(name.to_owned()).chain(equals).collect(),
        family,
        parameters,
        confidence,
        channel: if side == Side::Labels { "labels" } else { "objects" },
        covariate: covariate.into(),
        held_out_gains,
        says,
        separate_by,
        curve: curve(rows, x_column, axis, fitted),
    }
}

fn curve(rows: &[Row], column: usize, axis: usize, fitted: &LinearFit) -> Curve {
    let mut points: Vec<(f64, f64, f64)> = rows
        .iter()
        .map(|r| {
            let told = fitted.columns.iter().zip(fitted.theta.iter()).map(|(&c, t)| r.x[axis][c] * t).sum::<f64>();
            let x = if column == 4 {
                r.speed.unwrap_or(0.0)
            } else {
                r.x[axis.min(if column == 6 { 1 } else { 0 })][column]
            };
            (x, r.shift[axis], told)
        })
        .collect();
    points.sort_by(|a, b| a.0.total_cmp(&b.0));
    let per = (points.len() / 12).max(1);
    let points = points.chunks(per).map(|chunk| {
        let n = chunk.len() as f64;
        let mean = |f: fn(&(f64, f64, f64)) -> f64| chunk.iter().map(f).sum::<f64>() / n;
        let measured = mean(|p| p.1);
        let sd = (chunk.iter().map(|p| (p.1 - measured).powi(2)).sum::<f64>() / n).sqrt();
        CurvePoint { x: mean(|p| p.0), measured, before: 0.0, after: mean(|p| p.2), error: sd / n.sqrt() }
    });
    let x = match column {
        3 => "velocity that the sensor sees, forward, m/s",
        4 => "velocity over the ground, m/s",
        7 => "velocity times phase of the scan, m/s",
        _ => "side seen (1: front or left, -1: rear or right)",
    };
    Curve { x: x.into(), y: format!("shift {}, m", ["forward", "left", "up"][axis]), points: points.collect() }
}
