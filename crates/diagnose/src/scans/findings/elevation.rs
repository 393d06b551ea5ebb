//! A common elevation error of all lasers, from the ground and from walls.

use super::{others, parameter, spread};
use crate::catalogue::sizes::LASERS_ELEVATION_DEG;
use crate::catalogue::{Cause, Channel, Covariate, Quantity};
use crate::curve::{Curve, CurvePoint};
use crate::diagnosis::{Finding, FindingGain, Status};
use crate::scans::{Seen, gain_of, tilt};
use std::collections::BTreeMap;

/// 0.975 quantile of Student's t over its degrees of freedom, from one on.
fn t975(freedom: usize) -> f64 {
    const TABLE: [f64; 12] = [12.7, 4.30, 3.18, 2.78, 2.57, 2.45, 2.36, 2.31, 2.26, 2.23, 2.20, 2.18];
    TABLE.get(freedom.max(1) - 1).copied().unwrap_or(2.0)
}

/// Mean over scans and its 95 % interval; `None` with fewer than three.
fn mean_and_interval(values: &[f64]) -> Option<(f64, [f64; 2])> {
    let n = values.len();
    let mean = values.iter().sum::<f64>() / n.max(1) as f64;
    let error = spread(values.iter().copied()) / (n.max(2) as f64 - 1.0).sqrt();
    (n >= 3).then(|| (mean, [mean - t975(n - 1) * error, mean + t975(n - 1) * error]))
}

/// Distance at which the plot of the ground is zero, m: the middle of the column of [`tilt::by_ground`].
const MIDDLE_M: f64 = 12.0;

/// Width of a bin of the plot, m.
const BIN_M: f64 = 1.5;

/// Elevation error by the ground of one scan.
struct ByGround {
    scan: usize,
    /// rad.
    error: f64,
    /// Points of the plot: distance, height over the plane, number.
    points: Vec<[f64; 3]>,
}

/// The finding: named where walls confirm what the ground shows, else ambiguous with the shape of the ground.
pub(super) fn elevation_found(seen: &Seen, notes: &mut Vec<String>) -> Option<Finding> {
    let of_scan = |scan: usize| {
        let plane = &seen.ground[scan].as_ref()?.plane;
        let (error, points) = tilt::by_ground(&seen.scans[scan], &seen.beams, plane)?;
        Some(ByGround { scan, error, points })
    };
    let grounds: Vec<ByGround> = (0..seen.scans.len()).filter_map(of_scan).collect();
    let by_walls: Vec<f64> = (0..seen.scans.len())
        .filter_map(|s| tilt::by_walls(&seen.walls[s], &seen.beams, &seen.ground[s].as_ref()?.plane))
        .collect();
    let by_ground: Vec<f64> = grounds.iter().map(|g| g.error).collect();
    let Some((mean, ci)) = mean_and_interval(&by_ground) else {
        notes.push("too few scans show the ground: nothing can be said of an error of all elevations".into());
        return None;
    };
    let walls = mean_and_interval(&by_walls);
    let outside = |ci: [f64; 2]| ci[0] > 0.0 || ci[1] < 0.0;
    let confirmed = walls.is_some_and(|(_, w)| outside(w) && w[0] < ci[1] && w[1] > ci[0]);
    if !outside(ci) && mean.to_degrees().abs() < LASERS_ELEVATION_DEG {
        return None;
    }
    let named = confirmed && outside(ci);
    let degrees =
        |quantity, (mean, ci): (f64, [f64; 2])| parameter(quantity, mean.to_degrees(), ci.map(f64::to_degrees));
    let mut parameters = vec![degrees(Quantity::MeanDeg, (mean, ci))];
    parameters.extend(walls.map(|walls| degrees(Quantity::MeanByWallsDeg, walls)));
    Some(Finding {
        status: if named { Status::Named } else { Status::Ambiguous },
        cause: named.then_some(Cause::BeamElevationOffset),
        candidates: (!named).then(|| vec![Cause::BeamElevationOffset, Cause::GroundError]),
        family: Cause::BeamElevationOffset.family(),
        parameters: parameters.into_iter().collect(),
        confidence: if named { 0.95 } else { 0.5 },
        channel: Channel::Residuals,
        covariate: Covariate::DistanceOnTheGround,
        gain: gain(seen, &grounds),
        predicted: None,
        reached: None,
        says: says((mean, ci), walls),
        separate_by: (!named)
            .then(|| "a level hall or a survey of the road under the car, and plumb walls on all sides".into()),
        curve: curve(&grounds, mean),
        effects: vec![],
    })
}

/// The finding in a sentence; means and intervals by the ground and by walls, rad.
fn says((mean, ci): (f64, [f64; 2]), walls: Option<(f64, [f64; 2])>) -> String {
    let deg = f64::to_degrees;
    let by_walls = walls.map_or_else(
        || "too few walls to ask them".to_owned(),
        |(m, c)| format!("the lean of walls gives {:.3} degrees ({:.3} to {:.3})", deg(m), deg(c[0]), deg(c[1])),
    );
    format!(
        "the ground around the car is a cone, as if all lasers aimed {:.3} degrees ({:.3} to {:.3}) higher than believed; roads are convex and crowned as well, and {by_walls}",
        deg(mean),
        deg(ci[0]),
        deg(ci[1])
    )
}

/// Gain of each scan by the mean of the others, in units of their scatter.
fn gain(seen: &Seen, grounds: &[ByGround]) -> FindingGain {
    let of_scan = |(s, ground): (usize, &ByGround)| {
        let rest: Vec<f64> = others(grounds.len(), s).map(|i| grounds[i].error).collect();
        let m = rest.iter().sum::<f64>() / rest.len().max(1) as f64;
        let v = spread(rest.iter().copied()).powi(2).max(1e-8);
        let returns: f64 = seen.scans[ground.scan].rings.iter().map(|r| r.len() as f64).sum();
        [0.5 * (ground.error.powi(2) - (ground.error - m).powi(2)) / v, returns]
    };
    gain_of(&grounds.iter().enumerate().map(of_scan).collect::<Vec<_>>())
}

/// Height of the ground over its plane by distance.
fn curve(grounds: &[ByGround], mean: f64) -> Curve {
    let mut bins = BTreeMap::<i64, [f64; 4]>::new();
    for [x, y, _] in grounds.iter().flat_map(|g| &g.points) {
        let bin = bins.entry((x / BIN_M) as i64).or_default();
        *bin = [bin[0] + 1.0, bin[1] + x, bin[2] + y, bin[3] + y * y];
    }
    let points = bins.into_values().filter(|b| b[0] >= 2.0).map(|[n, x, y, yy]| {
        let (x, y) = (x / n, y / n);
        CurvePoint {
            sensor: 0,
            x,
            measured: y,
            before: 0.0,
            after: -mean * (x - MIDDLE_M),
            error: ((yy / n - y * y).max(0.0) / n).sqrt(),
        }
    });
    Curve {
        x: "distance, m".into(),
        y: "height of the ground over its plane, m".into(),
        by_sensor: false,
        points: points.collect(),
    }
}
