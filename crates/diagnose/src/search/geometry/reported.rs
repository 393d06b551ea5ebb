//! The fit that findings report.

use super::Search;
use super::beside_rows::{self, BesideRows};
use super::directions;
use super::hypotheses::Hypothesis;
use crate::inference::linear::{LinearFit, at_least};
use std::borrow::Cow;

/// The fit that is reported.
pub(super) fn fit_of<'a>(search: &'a Search, chosen: &[Hypothesis]) -> Cow<'a, LinearFit> {
    match &search.reported {
        Some(reported) => Cow::Borrowed(&reported.linear),
        None => Cow::Owned(search.sums.fit_all(&search.estimate, &search.estimate_blocks, chosen)),
    }
}

/// The fit on the estimating frames.
pub(super) struct Reported {
    /// Of the base model and the linear causes. Variances are at least those by directions.
    pub(super) linear: LinearFit,
    /// With the offsets of rows, where such were chosen.
    pub(super) rows: Option<BesideRows>,
}

impl Reported {
    pub(super) fn new(search: &Search, chosen: &[Hypothesis]) -> Reported {
        let rows = beside_rows::fit(search, chosen);
        let alone = || search.sums.fit_all(&search.estimate, &search.estimate_blocks, chosen);
        let mut linear = rows.as_ref().map_or_else(alone, |fit| fit.linear.clone());
        let by_directions = directions::scatter(search, &linear, rows.as_ref());
        linear.covariance = at_least(linear.covariance, &by_directions);
        Reported { linear, rows }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::catalogue::Cause;
    use crate::channels::groups::{Group, Grouping, elevation_lever};
    use crate::channels::mean::Column;
    use crate::inference::roles::{Role, roles};
    use crate::pairing::{FramePair, OCTANTS, Ray, Surface};
    use crate::search::Context;
    use nalgebra::{UnitQuaternion, Vector3};
    use rand_distr::{Distribution, StandardNormal};
    use sensor::Rig;

    /// Rows of the sensor.
    const ROWS: u16 = 24;

    /// Offset of all ranges, m.
    const BIAS_M: f64 = 0.05;

    /// Frames of a road 2 m below the sensor and of walls around it, with ranges that are too long; rows aim elsewhere,
    /// and the surfaces in each octant stand elsewhere.
    fn frames(rows_rad: &[f64], octants_m: [f64; OCTANTS]) -> Vec<FramePair> {
        let mut rng = data::stream(11, "reported", 0, 0);
        let mut frame = |number: usize| {
            let shot = |k: u32| {
                let (row, azimuth) = (k / 240, std::f64::consts::TAU * f64::from(k % 240) / 240.0);
                let elevation = 0.03 * f64::from(row) - 0.45;
                let flat = Vector3::new(azimuth.cos(), azimuth.sin(), 0.0);
                (row as u16, flat * elevation.cos() + Vector3::z() * elevation.sin())
            };
            let mut return_ = |(row, direction): (u16, Vector3<f64>)| {
                // Walls to the left and right, 8 m away, and before and behind, farther from frame to frame.
                let walls = [(Vector3::y(), 8.0), (Vector3::x(), 12.0 + 0.5 * number as f64)];
                let wall = |(axis, m): (Vector3<f64>, f64)| {
                    let along = axis.dot(&direction);
                    (m / along.abs(), -axis * along.signum(), Surface::Standing)
                };
                let ground = (direction.z < 0.0).then(|| (-2.0 / direction.z, Vector3::z(), Surface::Ground));
                let met = walls.map(wall).into_iter().chain(ground);
                let (range_m, normal, surface) = met.min_by(|a, b| a.0.total_cmp(&b.0)).unwrap();
                let cos_incidence = -normal.dot(&direction);
                let mut ray = Ray {
                    surface,
                    row,
                    normal: normal.cast::<f32>().into(),
                    cos_incidence: cos_incidence as f32,
                    ..Ray::standing(&(direction * range_m))
                };
                let noise: f64 = StandardNormal.sample(&mut rng);
                let turned_m = elevation_lever(&ray, &UnitQuaternion::identity()) * rows_rad[usize::from(row)];
                let across_m = turned_m + octants_m[ray.octant()];
                ray.residual_m = (BIAS_M + 0.01 * noise - across_m / cos_incidence) as f32;
                ray
            };
            let measured = (0..240 * u32::from(ROWS)).map(|k| return_(shot(k))).collect();
            FramePair::of_rays(format!("{number:06}"), measured, vec![])
        };
        (0..24).map(&mut frame).collect()
    }

    /// The fit of a bias beside offsets of rows in elevation, or alone; with its estimate and error, and those without
    /// rows and directions.
    fn fitted(frames: &[FramePair], with_rows: bool) -> (Reported, [[f64; 2]; 2]) {
        let rig = Rig::single();
        let roles = roles(frames.len());
        let context = Context { rig: &rig, frames, roles, times: None, motion: None, to_next: vec![] };
        let search = Search::new(&context, None);
        let bias = search.sums.columns.iter().position(|c| *c == Column::RangeOffset).unwrap();
        let mut chosen = vec![Hypothesis::Linear { cause: Cause::RangeBias, columns: vec![bias] }];
        if with_rows {
            let cause = Cause::BeamElevationOffset;
            chosen.push(Hypothesis::Groups { cause, grouping: Grouping::Row, column: 1 });
        }
        let reported = Reported::new(&search, &chosen);
        let alone = search.sums.fit_all(&context.of(Role::Estimate), &search.estimate_blocks, &chosen);
        let of = |fit: &LinearFit| search.sums.fitted(fit, Column::RangeOffset).unwrap();
        let numbers = [of(&reported.linear), of(&alone)];
        (reported, numbers)
    }

    #[test]
    fn a_bias_is_not_what_rows_that_aim_elsewhere_look_like() {
        let mut rng = data::stream(12, "rows", 0, 0);
        let mut squares = [0.0; 2];
        for _ in 0..6 {
            let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
            let rows_rad: Vec<f64> = (0..ROWS).map(|_| 1e-3 * normal()).collect();
            let (reported, numbers) = fitted(&frames(&rows_rad, [0.0; OCTANTS]), true);
            let [[with, error], [without, _]] = numbers;
            assert!((with - BIAS_M).abs() < 4.0 * error && error < 0.01, "{numbers:?}");
            squares[0] += (with - BIAS_M).powi(2);
            squares[1] += (without - BIAS_M).powi(2);
            let rows = reported.rows.unwrap();
            let [more, variance] = rows.more(1, Group { sensor: 0, index: 3 }, &reported.linear, &[]);
            assert!(more == 0.0 && variance > 0.0);
        }
        assert!(squares[0] < 0.25 * squares[1], "{squares:?}");
    }

    #[test]
    fn surfaces_that_stand_elsewhere_in_one_direction_are_an_error_of_all_frames() {
        let level = vec![0.0; usize::from(ROWS)];
        let [_, [_, by_frames]] = fitted(&frames(&level, [0.0; OCTANTS]), false).1;
        let octants_m = [0.01, -0.008, 0.005, 0.0, -0.01, 0.009, -0.006, 0.0];
        let numbers = fitted(&frames(&level, octants_m), false).1;
        let [[with, error], [_, alone]] = numbers;
        assert!(error > 3.0 * by_frames && error > 2.0 * alone, "{numbers:?} {by_frames}");
        assert!((with - BIAS_M).abs() < 3.0 * error, "{numbers:?}");
    }
}
