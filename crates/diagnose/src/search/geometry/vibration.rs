//! A vehicle or a mount that tilts within a scan, otherwise in each. Where shots go up or down together, near ground of
//! one direction lies higher or lower than simulated, and far ground of the same direction by so much more. The world
//! does not do that: what is uneven near the vehicle says nothing about what is farther away.

use super::ground::outcome;
use crate::catalogue::sizes::TURN_RAD;
use crate::catalogue::{Cause, Channel, Covariate};
use crate::channels::heights::{Cell, Heights, common_std, heights, largest_of_ground};
use crate::channels::mean::origins;
use crate::curve::{Curve, means};
use crate::diagnosis::Status;
use crate::inference::choice::total_and_z;
use crate::inference::linear::{LinearFrame, cross_gains, fit};
use crate::inference::roles::Role;
use crate::pairing::Ray;
use crate::search::{ChannelResult, Context, Found};
use nalgebra::{DMatrix, DVector, Matrix3, Point3, Vector2, Vector3};
use std::collections::BTreeMap;
use std::f64::consts::{PI, TAU};

/// Directions of each sensor: shots of one of them are sent within a hundredth of a second.
const SECTORS: i32 = 24;

/// Width of a step of distance, m.
const STEP_M: f64 = 2.0;

/// Largest standard error of the tilt by near ground that is used, rad.
const LEAST_SURE_RAD: f64 = 2e-3;

/// Prior precision of the share of the tilt of near ground that far ground has.
const PRIOR: [f64; 1] = [1.0];

/// Height of far ground in a direction, and its height by the tilt of near ground, m; its variance, m2, and its
/// lever, m.
#[derive(Clone, Copy, Debug)]
struct Pair {
    height_m: f64,
    by_near_m: f64,
    variance: f64,
    lever_m: f64,
}

impl Pair {
    /// Tilts by near and by far ground, rad.
    fn tilts(&self) -> [f64; 2] {
        [self.by_near_m, self.height_m].map(|m| m / self.lever_m)
    }
}

/// The search, on frames with what is known of the sensor undone.
pub fn search(context: &Context) -> ChannelResult {
    let [select, estimate, hold_out] = [Role::Select, Role::Estimate, Role::HoldOut].map(|role| context.of(role));
    let mut result = ChannelResult::new(Channel::Residuals, hold_out.len());
    let pairs = pairs(context);
    let sums: Vec<LinearFrame> = pairs.iter().map(|pairs| sums(pairs)).collect();
    let on = |which: &[usize]| which.iter().map(|&f| &sums[f]).collect::<Vec<_>>();
    let (total, z) = total_and_z(&cross_gains(&on(&select), &context.blocks(&select), &[0], &PRIOR));
    let [on_select, on_estimate] = [&select, &estimate].map(|which| tilt_rad(&pairs, which, &context.blocks(which)));
    let outcome = outcome((total, z), [on_select, on_estimate], TURN_RAD);
    result.consider(Cause::Unexplained, (total, z), context.returns(&select), outcome);
    if outcome == "chosen" {
        let fitted = fit(&on(&estimate), &context.blocks(&estimate), &[0], &PRIOR);
        let gains: Vec<f64> = hold_out.iter().map(|&f| fitted.gain(&sums[f])).collect();
        result.distance = gains.iter().map(|g| [g.max(0.0), *g, *g]).collect();
        result.found.push(found(&pairs, &estimate, on_estimate[0], gains));
    }
    result
}

/// Sector of a direction.
fn sector_of(azimuth_rad: f64) -> i32 {
    ((azimuth_rad + PI) / TAU * f64::from(SECTORS)).floor().clamp(0.0, f64::from(SECTORS - 1)) as i32
}

/// Of each frame the heights of far ground beside those by near ground of the same sector.
fn pairs(context: &Context) -> Vec<Vec<Pair>> {
    let origins = origins(context.rig);
    let cell_of = |ray: &Ray, place: &Vector2<f64>| -> Cell {
        let from = place - origins[usize::from(ray.sensor)].coords.xy();
        [i32::from(ray.sensor) * SECTORS + sector_of(from.y.atan2(from.x)), (from.norm() / STEP_M) as i32]
    };
    let mut heights = heights(context.frames, context.rig, cell_of);
    heights.iter_mut().for_each(|frame| take_out_plane(frame, &origins));
    let middle = middle(&heights, &origins);
    let mut pairs: Vec<Vec<Pair>> = heights.iter().map(|frame| of_frame(frame, &origins, middle)).collect();
    let most = largest_of_ground(pairs.iter().flatten().flat_map(Pair::tilts));
    pairs.iter_mut().for_each(|frame| frame.retain(|p| p.tilts().iter().all(|tilt| tilt.abs() <= most)));
    pairs
}

/// Step of distance up to which ground is near: near and far ground tell as much of a tilt.
fn middle(heights: &[Heights], origins: &[Point3<f64>]) -> i32 {
    let mut by_step = BTreeMap::<i32, f64>::new();
    for (cell, [_, variance]) in heights.iter().flatten() {
        *by_step.entry(cell[1]).or_default() += lever_m(cell, origins).powi(2) / variance;
    }
    let mut left = 0.5 * by_step.values().sum::<f64>();
    let beyond = by_step.iter().find(|(_, weight)| {
        left -= **weight;
        left < 0.0
    });
    beyond.map_or(0, |(step, _)| *step)
}

/// Lever of a cell about the vehicle's origin, m: its way out in its direction.
fn lever_m(cell: &Cell, origins: &[Point3<f64>]) -> f64 {
    let (direction, place) = place_of(cell, origins);
    direction.dot(&place)
}

/// Direction of a cell and its place, in the vehicle's axes.
fn place_of([sector, step]: &Cell, origins: &[Point3<f64>]) -> (Vector2<f64>, Vector2<f64>) {
    let azimuth_rad = (f64::from(sector % SECTORS) + 0.5) * TAU / f64::from(SECTORS) - PI;
    let direction = Vector2::new(azimuth_rad.cos(), azimuth_rad.sin());
    (direction, origins[(sector / SECTORS) as usize].coords.xy() + direction * (f64::from(*step) + 0.5) * STEP_M)
}

/// Takes out what the ground of a frame has as a whole: height and tilt.
fn take_out_plane(frame: &mut Heights, origins: &[Point3<f64>]) {
    let row = |cell: &Cell| {
        let place = place_of(cell, origins).1;
        Vector3::new(1.0, place.x, place.y)
    };
    let (mut gram, mut right) = (Matrix3::identity() * 1e-6, Vector3::zeros());
    for (cell, [height_m, variance]) in frame.iter() {
        let x = row(cell);
        gram += x * x.transpose() / *variance;
        right += x * (height_m / variance);
    }
    let plane = gram.cholesky().map_or_else(Vector3::zeros, |g| g.solve(&right));
    frame.iter_mut().for_each(|(cell, [height_m, _])| *height_m -= row(cell).dot(&plane));
}

fn of_frame(frame: &Heights, origins: &[Point3<f64>], middle: i32) -> Vec<Pair> {
    let mut near = BTreeMap::<i32, [f64; 2]>::new();
    let is_near = |cell: &Cell| cell[1] <= middle;
    for (cell, [height_m, variance]) in frame.iter().filter(|(cell, _)| is_near(cell)) {
        let (sums, lever_m) = (near.entry(cell[0]).or_default(), lever_m(cell, origins));
        *sums = [sums[0] + lever_m * lever_m / variance, sums[1] + lever_m * height_m / variance];
    }
    let far = |(cell, [height_m, variance]): (&Cell, &[f64; 2])| {
        let [gram, right] = near.get(&cell[0]).filter(|[gram, _]| *gram > LEAST_SURE_RAD.powi(-2))?;
        let lever_m = lever_m(cell, origins);
        Some(Pair { height_m: *height_m, by_near_m: lever_m * right / gram, variance: *variance, lever_m })
    };
    frame.iter().filter(|(cell, _)| !is_near(cell)).filter_map(far).collect()
}

/// Sums of a frame.
fn sums(pairs: &[Pair]) -> LinearFrame {
    let [gram, right] = pairs.iter().fold([0.0; 2], |s, p| {
        [s[0] + p.by_near_m * p.by_near_m / p.variance, s[1] + p.by_near_m * p.height_m / p.variance]
    });
    LinearFrame { gram: DMatrix::from_element(1, 1, gram), right: DVector::from_element(1, right) }
}

/// Standard deviation of the tilt that near and far ground agree on, rad, with its error.
fn tilt_rad(pairs: &[Vec<Pair>], which: &[usize], blocks: &[usize]) -> [f64; 2] {
    let of_frame = |f: usize| {
        pairs[f].iter().fold([0.0; 2], |s, p| {
            [s[0] + p.lever_m * p.lever_m / p.variance, s[1] + p.height_m * p.by_near_m / p.variance]
        })
    };
    common_std(which.iter().zip(blocks).map(|(&f, block)| (*block, of_frame(f))))
}

fn found(pairs: &[Vec<Pair>], estimate: &[usize], tilt_rad: f64, held_out_gains: Vec<f64>) -> Found {
    Found {
        status: Status::Unexplained,
        causes: vec![],
        parameters: vec![],
        confidence: 1.0,
        channel: Channel::Residuals,
        covariate: Covariate::ScanPhase,
        held_out_gains,
        says: format!(
            "the scene tilts within a scan, otherwise in each: by {:.3} degrees, standard deviation, beyond the tilt of \
             the scan as a whole; mounts or the vehicle vibrate, and no cause of the catalogue does that",
            tilt_rad.to_degrees()
        ),
        separate_by: None,
        curve: curve(pairs, estimate),
        effects: vec![],
    }
}

/// Tilts of far ground over those of near ground of the same direction and frame.
fn curve(pairs: &[Vec<Pair>], estimate: &[usize]) -> Curve {
    let tilts = |&f: &usize| pairs[f].iter().map(|p| p.tilts().map(f64::to_degrees));
    Curve {
        x: "tilt of near ground, degrees".into(),
        y: "tilt of far ground in the same direction, degrees".into(),
        by_sensor: false,
        points: means(estimate.iter().flat_map(tilts).collect()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::channels::heights::testing::{found_in, wave};

    /// Height of the ground where the vehicle tilts within a scan, otherwise in each.
    fn tilted(own: Vector2<f64>, f: usize, tilt_rad: f64) -> f64 {
        own.norm() * tilt_rad * (2.0 * own.y.atan2(own.x) + 1.7 * f as f64).sin()
    }

    #[test]
    fn a_vehicle_that_vibrates_is_found_and_has_no_name() {
        let result = found_in(search, |world, own, f| tilted(own, f, 2e-3) + 0.3 * wave(world));
        let [found] = &result.found[..] else { panic!("{:?}", result.considered) };
        assert!(found.causes.is_empty() && found.covariate == Covariate::ScanPhase, "{}", found.says);
        // 2e-3 / sqrt(2) rad.
        assert!(found.says.contains("by 0.08"), "{}", found.says);
    }

    #[test]
    fn ground_that_rolls_or_is_elsewhere_in_all_frames_is_no_vibration() {
        assert!(found_in(search, |world, _, _| wave(world)).found.is_empty());
        assert!(found_in(search, |_, own, _| tilted(own, 0, 4e-3)).found.is_empty());
        // A tilt of the whole scan is the pose of its frame.
        assert!(found_in(search, |_, own, f| 3e-3 * (1.7 * f as f64).sin() * own.x).found.is_empty());
    }
}
