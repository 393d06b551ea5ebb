//! Scenario identity: each measured frame must match its own simulated frame better than other frames.

use super::recordings::{PairSide, Recordings};
use crate::error::DiagnoseError;
use crate::inference::median;
use data::Object;
use nalgebra::Vector3;
use rayon::prelude::*;
use sensor::directions::{DirectionIndex, SensorScan, Sensors, Steps, fit_surface};

/// Result of the comparison.
#[derive(Clone, Debug, PartialEq)]
pub struct Identity {
    /// Whether the two sides show the same scenes.
    pub identical: bool,
    /// The reason where they do not; empty where they do.
    pub reason: String,
    /// Frames that do not match their own simulated frame although most others do.
    pub strangers: Vec<String>,
}

/// Number of measured frames that are compared.
const FRAMES: usize = 16;

/// Measured returns of a frame that are compared, at most.
const RETURNS: usize = 1_500;

/// Mean distance below which two frames are identical whatever the distance of other frames, m.
const SAME_M: f64 = 0.05;

/// Smallest share of frames that match their own simulated frame best. By chance a sixth does among six; but on a
/// straight road frames look alike, and many match any other.
const FIT: f64 = 0.85;

/// Largest distance of the labels of identical frames, in units of 4 m: labels may be late by a few hundredths of a
/// second.
const LATE: f64 = 0.35;

/// Compares some measured frames with their own simulated frame, with its neighbours and with distant frames.
pub fn check_identity(recordings: &Recordings, sensors: &Sensors) -> Result<Identity, DiagnoseError> {
    let n = recordings.len();
    if n < 2 {
        return Ok(Identity { identical: true, reason: String::new(), strangers: vec![] });
    }
    let step = n.div_ceil(FRAMES).max(1);
    let chosen: Vec<usize> = (0..n).step_by(step).collect();
    let lags: Vec<i64> = [-2i64, -1, 1, 2].into_iter().filter(|l| l.unsigned_abs() < n as u64 / 4).collect();
    let mut far: Vec<usize> = (1..6).map(|k| k * n / 6).filter(|&k| k > 2 || n < 18 && k > 0).collect();
    far.dedup();
    let rows = chosen.par_iter().map(|&i| {
        let parts = |j: usize| distance(recordings, i, j, sensors);
        let score = |j: usize| parts(j).map(|[cloud, labels]| cloud + LABELS_COUNT * labels);
        let [cloud, labels] = parts(i)?;
        let own = cloud + LABELS_COUNT * labels;
        let mut near = Vec::new();
        for lag in &lags {
            let j = i as i64 + lag;
            near.push(if (0..n as i64).contains(&j) { Some(score(j as usize)?) } else { None });
        }
        let strangers = far.iter().map(|k| score((i + k) % n)).collect::<Result<Vec<_>, _>>()?;
        Ok(FrameScores { frame: i, own, same: cloud < SAME_M && labels < LATE, near, strangers })
    });
    Ok(judge(&super::in_order(rows)?, &lags, &|frame| recordings.id(frame).to_owned()))
}

struct FrameScores {
    frame: usize,
    own: f64,
    /// Whether the own frame is identical whatever the distance of others.
    same: bool,
    near: Vec<Option<f64>>,
    strangers: Vec<f64>,
}

fn judge(rows: &[FrameScores], lags: &[i64], id: &dyn Fn(usize) -> String) -> Identity {
    let beaten = |r: &FrameScores| !r.same && r.strangers.iter().any(|s| *s <= r.own);
    let fits = rows.iter().filter(|r| !beaten(r)).count();
    let strangers: Vec<String> = rows.iter().filter(|r| beaten(r)).map(|r| id(r.frame)).collect();
    let own_mean = rows.iter().map(|r| r.own).sum::<f64>() / rows.len() as f64;
    if (fits as f64) < FIT * rows.len() as f64 {
        return Identity {
            identical: false,
            reason: format!(
                "not scenario-identical: of {} measured frames only {fits} fit the simulated frame of the same id better than frames of other ids (mean distance {own_mean:.2} m)",
                rows.len()
            ),
            strangers,
        };
    }
    for (k, lag) in lags.iter().enumerate() {
        let both: Vec<(f64, f64)> = rows.iter().filter_map(|r| Some((r.own, r.near[k]?))).collect();
        let better = both.iter().filter(|(own, near)| *near < 0.7 * own && *own > 2.0 * SAME_M).count();
        if both.len() >= 4 && better as f64 > 0.7 * both.len() as f64 {
            return Identity {
                identical: false,
                reason: format!(
                    "not scenario-identical: measured frames fit the simulated frame {} places {} better than that of their own id ({better} of {})",
                    lag.abs(),
                    if *lag > 0 { "later" } else { "earlier" },
                    both.len()
                ),
                strangers,
            };
        }
    }
    Identity { identical: true, reason: String::new(), strangers }
}

/// Cosine of incidence from which on a surface is a standing one rather than distant ground.
const SQUARELY: f64 = 0.15;

/// Whether a return is used for the common range bias: on a standing surface, and within 1 m of it.
pub fn met_squarely(off_m: f64, cos_incidence: f64) -> bool {
    cos_incidence > SQUARELY && off_m.abs() < 1.0
}

/// Weight of the distances of labels beside those of returns.
const LABELS_COUNT: f64 = 0.5;

/// Mean distance of measured returns from the simulated surfaces, across them, at most 1 m each, the common range
/// bias subtracted; and that of the labels, see [`label_distance`].
fn distance(
    recordings: &Recordings,
    measured: usize,
    simulated: usize,
    sensors: &Sensors,
) -> Result<[f64; 2], DiagnoseError> {
    let (a, b) = (recordings.side(measured, PairSide::Measured)?, recordings.side(simulated, PairSide::Simulated)?);
    let total: usize = a.scans.iter().map(SensorScan::len).sum();
    let stride = (total / RETURNS).max(1);
    let mut met = Vec::new();
    for (k, (a, b)) in a.scans.iter().zip(&b.scans).enumerate() {
        let steps = sensors.patterns[k].steps;
        let window = Steps { azimuth_rad: 2.2 * steps.azimuth_rad, elevation_rad: 1.4 * steps.elevation_rad };
        let index = DirectionIndex::new(b, window, sensors.rig.sensors[k].is_full_circle());
        let size = [f64::from(window.azimuth_rad), f64::from(window.elevation_rad)];
        for i in (0..a.len()).step_by(stride) {
            let Some(s) = fit_surface(&index, size, a.azimuth_rad[i], a.elevation_rad[i], |_| true) else { continue };
            let off_m = f64::from(a.range_m[i]) - s.range_m;
            met.push((off_m, s.cos_incidence, if s.smooth(sensors.edge_m) { 0.0 } else { s.misfit_m }));
        }
    }
    // A common range bias does not make another scene.
    let squarely = met.iter().filter(|(off_m, cos, _)| met_squarely(*off_m, *cos)).map(|m| m.0);
    let bias_m = median(squarely.collect());
    let (mut sum, mut count) = (0.0, 0.0);
    for (off_m, cos, misfit_m) in met {
        // Distant ground is the same in every frame; standing surfaces are not.
        let weight = if cos > SQUARELY { 1.0 } else { 0.2 };
        sum += weight * (((off_m - bias_m) * cos).abs() - misfit_m).clamp(0.0, 1.0);
        count += weight;
    }
    let cloud = if count > 0.0 { sum / count } else { 1.0 };
    Ok([cloud, label_distance(&a.objects, &b.objects)])
}

/// Mean distance of each label from the nearest one of the other side, at most 4 m, in units of that.
fn label_distance(a: &[Object], b: &[Object]) -> f64 {
    if a.is_empty() && b.is_empty() {
        return 0.0;
    }
    let nearest = |from: &[Object], to: &[Object]| -> f64 {
        from.iter()
            .map(|x| {
                let d = |y: &Object| (Vector3::from(x.bbox.center) - Vector3::from(y.bbox.center)).norm();
                to.iter().map(d).fold(4.0, f64::min)
            })
            .sum()
    };
    // Up to 1 m does not make another scene.
    let mean = (nearest(a, b) + nearest(b, a)) / (a.len() + b.len()) as f64;
    (mean - 1.0).max(0.0) / 4.0
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rows(own: f64, near: f64, far: f64) -> Vec<FrameScores> {
        (0..10)
            .map(|i| FrameScores {
                frame: i,
                own,
                same: own < SAME_M,
                near: vec![Some(near)],
                strangers: vec![far, far * 1.1],
            })
            .collect()
    }

    #[test]
    fn own_frames_must_fit_best() {
        let id = |i: usize| i.to_string();
        assert!(judge(&rows(0.1, 0.2, 0.5), &[1], &id).identical);
        assert!(judge(&rows(0.01, 0.01, 0.01), &[1], &id).identical, "static scene");
        let shuffled = judge(&rows(0.5, 0.4, 0.4), &[1], &id);
        assert!(
            !shuffled.identical && shuffled.reason.contains("not scenario-identical") && shuffled.strangers.len() == 10
        );
        let late = judge(&rows(0.3, 0.02, 0.5), &[1], &id);
        assert!(!late.identical && late.reason.contains("1 places later"), "{}", late.reason);
    }
}
