//! An error of all elevations, as far as ground and walls tell.

use super::{others, parameter, spread};
use crate::diagnosis::{Curve, CurvePoint, Finding, Status};
use crate::scans::{Seen, gain_of, tilt};
use std::collections::BTreeMap;

/// 0.975 quantile of Student's t over its degrees of freedom, from one on.
fn t975(freedom: usize) -> f64 {
    const TABLE: [f64; 12] = [12.7, 4.30, 3.18, 2.78, 2.57, 2.45, 2.36, 2.31, 2.26, 2.23, 2.20, 2.18];
    TABLE.get(freedom.max(1) - 1).copied().unwrap_or(2.0)
}

/// Mean of what scans tell, and its 95 % interval.
fn mean_and_interval(values: &[f64]) -> Option<(f64, [f64; 2])> {
    let n = values.len();
    let mean = values.iter().sum::<f64>() / n.max(1) as f64;
    let error = spread(values.iter().copied()) / (n.max(2) as f64 - 1.0).sqrt();
    (n >= 3).then(|| (mean, [mean - t975(n - 1) * error, mean + t975(n - 1) * error]))
}

pub(super) fn elevation_found(seen: &Seen, notes: &mut Vec<String>) -> Option<Finding> {
    let grounds: Vec<(usize, f64, Vec<[f64; 3]>)> = (0..seen.scans.len())
        .filter_map(|s| {
            let (error, picture) = tilt::by_ground(&seen.scans[s], &seen.beams, &seen.ground[s].as_ref()?.plane)?;
            Some((s, error, picture))
        })
        .collect();
    let by_walls: Vec<f64> = (0..seen.scans.len())
        .filter_map(|s| tilt::by_walls(&seen.walls[s], &seen.beams, &seen.ground[s].as_ref()?.plane))
        .collect();
    let by_ground: Vec<f64> = grounds.iter().map(|g| g.1).collect();
    let Some((mean, ci)) = mean_and_interval(&by_ground) else {
        notes.push("too few scans show the ground: nothing can be said of an error of all elevations".into());
        return None;
    };
    let walls = mean_and_interval(&by_walls);
    let deg = |v: f64| v.to_degrees();
    let outside = |ci: [f64; 2]| ci[0] > 0.0 || ci[1] < 0.0;
    let confirmed = walls.is_some_and(|(_, w)| outside(w) && w[0] < ci[1] && w[1] > ci[0]);
    if !outside(ci) && deg(mean).abs() < 0.03 {
        return None;
    }
    let told_by_walls = walls.map_or_else(
        || "too few walls to ask them".to_owned(),
        |(m, c)| format!("the lean of walls gives {:.3} degrees ({:.3} to {:.3})", deg(m), deg(c[0]), deg(c[1])),
    );
    let named = confirmed && outside(ci);
    let mut parameters = BTreeMap::from([("mean_deg".to_owned(), parameter(deg(mean), "deg", ci.map(deg)))]);
    if let Some((m, c)) = walls {
        parameters.insert("mean_by_walls_deg".into(), parameter(deg(m), "deg", c.map(deg)));
    }
    let mut bins = BTreeMap::<i64, [f64; 4]>::new();
    for [x, y, _] in grounds.iter().flat_map(|g| &g.2) {
        let bin = bins.entry((x / 1.5) as i64).or_default();
        *bin = [bin[0] + 1.0, bin[1] + x, bin[2] + y, bin[3] + y * y];
    }
    let points = bins.into_values().filter(|b| b[0] >= 2.0).map(|[n, x, y, yy]| {
        let (x, y) = (x / n, y / n);
        CurvePoint {
            x,
            measured: y,
            before: 0.0,
            after: -mean * (x - 12.0),
            error: ((yy / n - y * y).max(0.0) / n).sqrt(),
        }
    });
    // Of each scan what the mean of the others takes out of its own slope, in units of their scatter.
    let gains: Vec<[f64; 2]> = (0..by_ground.len())
        .map(|s| {
            let rest: Vec<f64> = others(by_ground.len(), s).map(|i| by_ground[i]).collect();
            let m = rest.iter().sum::<f64>() / rest.len().max(1) as f64;
            let v = spread(rest.iter().copied()).powi(2).max(1e-8);
            let scan: f64 = seen.scans[grounds[s].0].rings.iter().map(|r| r.len() as f64).sum();
            [0.5 * (by_ground[s].powi(2) - (by_ground[s] - m).powi(2)) / v, scan]
        })
        .collect();
    Some(Finding {
        status: if named { Status::Named } else { Status::Ambiguous },
        cause: named.then(|| "beam_elevation_offset".into()),
        candidates: (!named).then(|| vec!["beam_elevation_offset".into(), "ground_error".into()]),
        family: "geometry".into(),
        parameters,
        confidence: if named { 0.95 } else { 0.5 },
        channel: "residuals".into(),
        covariate: "distance on the ground".into(),
        gain: gain_of(&gains),
        says: format!(
            "the ground around the car is a cone, as if all lasers aimed {:.3} degrees ({:.3} to {:.3}) higher than believed; roads are convex and crowned as well, and {told_by_walls}",
            deg(mean),
            deg(ci[0]),
            deg(ci[1])
        ),
        separate_by: (!named)
            .then(|| "a level hall or a survey of the road under the car, and plumb walls on all sides".into()),
        effects: vec![],
        curve: Curve {
            x: "distance, m".into(),
            y: "height of the ground over its plane, m".into(),
            points: points.collect(),
        },
    })
}
