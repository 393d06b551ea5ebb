//! Ground that is not where the simulation has it, place by place. What is amiss with the sensor or with the vehicle is
//! the same in the vehicle's axes, or changes from frame to frame; the ground is the same where it is, and the vehicle
//! passes over it.

use super::floor::FLOOR_DISPLACED_M;
use crate::catalogue::{Cause, Channel, Covariate, Quantity};
use crate::channels::mean::{OwnPoses, off_surface_m, origins, own_poses, usable, usual_noise_m, weight};
use crate::curve::{Curve, CurvePoint};
use crate::diagnosis::{Considered, Minimum, Status};
use crate::inference::choice::total_and_z;
use crate::inference::linear::{LinearFrame, cross_gains, fit};
use crate::inference::roles::Role;
use crate::pairing::{FramePair, Surface};
use crate::search::{ChannelResult, Context, Found, first_demands, parameter};
use nalgebra::{DMatrix, DVector, Point3, Rotation2, Vector2};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Width of a cell of the ground, m.
const CELL_M: f64 = 2.0;

/// Distances of the ground that is compared, m.
const NEAR_FAR_M: [f64; 2] = [3.0, 25.0];

/// Fewest returns of a cell.
const FEWEST: f64 = 4.0;

/// Fewest frames in which a cell of the vehicle's axes is seen, for their mean.
const FEWEST_FRAMES: usize = 5;

/// Least way between two frames that are compared, m: farther than what is the same in the vehicle's axes reaches.
const LEAST_WAY_M: f64 = 4.0;

/// Longest way between them, m.
const MOST_WAY_M: f64 = 15.0;

/// Standard deviation of small unevenness in a cell, m.
const UNEVEN_M: f64 = 0.003;

/// A cell, by its place in the vehicle's axes in units of its width.
type Cell = [i32; 2];

/// Height of the ground in a cell over the simulated one, m, with its variance.
type Heights = BTreeMap<Cell, [f64; 2]>;

/// The search, on frames with what is known of the sensor undone. Without the way from frame to frame nothing is known.
pub fn search(context: &Context) -> ChannelResult {
    let [select, estimate, hold_out] = [Role::Select, Role::Estimate, Role::HoldOut].map(|role| context.of(role));
    let mut result = ChannelResult::new(Channel::Residuals, hold_out.len());
    let Some(pairs) = pairs(context) else { return result };
    let sums: Vec<LinearFrame> = pairs.iter().map(|pairs| sums(pairs)).collect();
    let on = |which: &[usize]| which.iter().map(|&f| &sums[f]).collect::<Vec<_>>();
    let gains = gains_of_places(&on(&select), &context.blocks(&select));
    let (total, z) = total_and_z(&gains);
    let demands = first_demands();
    let [on_select, on_estimate] = [&select, &estimate].map(|which| std_m(&pairs, which, &context.blocks(which)));
    // Surfaces of a model lie beside the real ones by as much as the floor.
    let large = on_select[0] > FLOOR_DISPLACED_M && on_estimate[0] - 1.96 * on_estimate[1] > FLOOR_DISPLACED_M;
    let outcome = match (total > demands.nats && z > demands.z, large) {
        (false, _) => "no gain on frames that it was not fitted on",
        (true, false) => "too small to speak of",
        (true, true) => "chosen",
    };
    let nats_per_ray = total / context.returns(&select).max(1.0);
    let cause = Cause::GroundError.into();
    result.considered.push(Considered { cause, channel: result.channel, nats_per_ray, z, outcome: outcome.into() });
    result.minimum.push((Cause::GroundError, Minimum::new(Quantity::StdM, FLOOR_DISPLACED_M)));
    if outcome == "chosen" {
        let [fitted, without] =
            [&BOTH[..], &BOTH[1..]].map(|columns| fit(&on(&estimate), &context.blocks(&estimate), columns, &PRIOR));
        let gains: Vec<f64> = hold_out.iter().map(|&f| fitted.gain(&sums[f]) - without.gain(&sums[f])).collect();
        result.distance = gains.iter().map(|g| [g.max(0.0), *g, *g]).collect();
        result.found.push(found(&pairs, &estimate, on_estimate, gains));
    }
    result
}

/// Height of a cell in a frame; in another frame that of the same place, and that of the same cell of the vehicle's
/// axes, m; variance, m2.
type Pair = [f64; 4];

/// Columns of the fit of the heights of a frame: heights of the same places in another frame, and heights there of the
/// same cells of the vehicle's axes. A mount that vibrates tilts two frames alike.
const BOTH: [usize; 2] = [0, 1];

/// Prior precisions of the columns: shares of heights.
const PRIOR: [f64; 2] = [1.0; 2];

/// Gains by heights of the same places beside those of the same cells, fitted on other blocks, nats.
fn gains_of_places(frames: &[&LinearFrame], blocks: &[usize]) -> Vec<f64> {
    let [both, cells] = [&BOTH[..], &BOTH[1..]].map(|columns| cross_gains(frames, blocks, columns, &PRIOR));
    both.iter().zip(cells).map(|(both, cells)| both - cells).collect()
}

/// Of each frame the heights of its cells beside those of the same places in another frame.
fn pairs(context: &Context) -> Option<Vec<Vec<Pair>>> {
    let times = context.times.as_ref()?;
    let (origins, noise_m) = (origins(context.rig), usual_noise_m(context.frames));
    let of_frame = |frame: &FramePair| heights(frame, &own_poses(frame, &origins, noise_m), &origins, noise_m);
    let mut heights: Vec<Heights> = context.frames.par_iter().map(of_frame).collect();
    take_out_means(&mut heights);
    let of_frame = |f: usize| -> Vec<Pair> {
        let Some((g, way)) = another(context, times, f) else { return vec![] };
        let same = |(cell, [own_m, variance]): (&Cell, &[f64; 2])| {
            let place = way(Vector2::from(cell.map(|c| (f64::from(c) + 0.5) * CELL_M)));
            let [other_m, others] = heights[g].get(&cell_of(&place))?;
            let alike_m = heights[g].get(cell).map_or(0.0, |[height_m, _]| *height_m);
            Some([*own_m, *other_m, alike_m, variance + others])
        };
        heights[f].iter().filter_map(same).collect()
    };
    Some((0..context.frames.len()).map(of_frame).collect())
}

/// Heights by cell, with the frame's own pose taken out.
fn heights(frame: &FramePair, pose: &OwnPoses, origins: &[Point3<f64>], noise_m: f64) -> Heights {
    let mut cells = BTreeMap::<Cell, [f64; 3]>::new();
    for ray in frame.measured.iter().filter(|r| usable(r) && r.surface == Surface::Ground) {
        let origin = &origins[usize::from(ray.sensor)];
        let place = ray.predicted_point(origin).coords.xy();
        let Some(up_m) = off_surface_m(ray, origin, pose) else { continue };
        if (NEAR_FAR_M[0]..NEAR_FAR_M[1]).contains(&place.norm()) {
            let sums = cells.entry(cell_of(&place)).or_default();
            let w = weight(ray, noise_m);
            (sums[0], sums[1], sums[2]) = (sums[0] + 1.0, sums[1] + w, sums[2] + w * up_m);
        }
    }
    let height = |(cell, [_, w, wy]): (Cell, [f64; 3])| (cell, [wy / w, 1.0 / w + UNEVEN_M * UNEVEN_M]);
    cells.into_iter().filter(|(_, s)| s[0] >= FEWEST).map(height).collect()
}

fn cell_of(place: &Vector2<f64>) -> Cell {
    [place.x, place.y].map(|v| (v / CELL_M).floor() as i32)
}

/// Takes out what a cell of the vehicle's axes has in the mean over the frames.
fn take_out_means(frames: &mut [Heights]) {
    let mut means = BTreeMap::<Cell, (usize, f64)>::new();
    for (cell, [height_m, _]) in frames.iter().flatten() {
        let mean = means.entry(*cell).or_default();
        (mean.0, mean.1) = (mean.0 + 1, mean.1 + height_m);
    }
    for frame in frames {
        frame.retain(|cell, _| means[cell].0 >= FEWEST_FRAMES);
        frame.iter_mut().for_each(|(cell, [height_m, _])| *height_m -= means[cell].1 / means[cell].0 as f64);
    }
}

/// The next frame, or the one before, that is far enough from a frame, and where a place of the latter is in its axes.
fn another(context: &Context, times: &[f64], f: usize) -> Option<(usize, impl Fn(Vector2<f64>) -> Vector2<f64>)> {
    let step = |k: usize| {
        let own = context.to_next.get(k).copied().flatten()?;
        let dt = times[k + 1] - times[k];
        Some((own.velocity_m_s.xy() * dt, own.turn_rate_rad_s.z * dt))
    };
    let walked = |forward: bool| {
        let (mut at, mut turned) = (Vector2::zeros(), 0.0);
        let mut g = f;
        loop {
            let (to, sign) = if forward { (g + 1, 1.0) } else { (g.checked_sub(1)?, -1.0) };
            let (moved, turn) = step(g.min(to)).filter(|_| to < times.len())?;
            // In the middle of the step the vehicle has turned by half of it.
            at += Rotation2::new(turned + 0.5 * sign * turn) * moved * sign;
            turned += sign * turn;
            g = to;
            match at.norm() {
                way if way > MOST_WAY_M => return None,
                way if way > LEAST_WAY_M => return Some((g, at, turned)),
                _ => {}
            }
        }
    };
    let (g, at, turned) = walked(true).or_else(|| walked(false))?;
    Some((g, move |place: Vector2<f64>| Rotation2::new(-turned) * (place - at)))
}

/// Sums of a frame.
fn sums(pairs: &[Pair]) -> LinearFrame {
    let (mut gram, mut right) = (DMatrix::zeros(2, 2), DVector::zeros(2));
    for [own_m, place_m, cell_m, variance] in pairs {
        let x = DVector::from_row_slice(&[*place_m, *cell_m]);
        gram += &x * x.transpose() / *variance;
        right += x * (own_m / variance);
    }
    LinearFrame { gram, right }
}

/// Standard deviation of the heights that two frames agree on, m, with its error by the scatter of blocks.
fn std_m(pairs: &[Vec<Pair>], which: &[usize], blocks: &[usize]) -> [f64; 2] {
    let mut by_block = BTreeMap::<usize, [f64; 2]>::new();
    for (&f, block) in which.iter().zip(blocks) {
        let sums = by_block.entry(*block).or_default();
        pairs[f].iter().for_each(|[own_m, place_m, ..]| *sums = [sums[0] + 1.0, sums[1] + own_m * place_m]);
    }
    let [n, product] = by_block.values().fold([0.0; 2], |s, b| [s[0] + b[0], s[1] + b[1]]);
    let (n, blocks) = (f64::max(n, 1.0), by_block.len() as f64);
    let mean = product / n;
    let scatter: f64 = by_block.values().map(|[n, product]| (product - mean * n).powi(2)).sum();
    let error = (scatter * blocks / (blocks - 1.0).max(1.0)).sqrt() / n;
    let std_m = mean.max(0.0).sqrt();
    [std_m, error / (2.0 * std_m).max(1e-6)]
}

fn found(pairs: &[Vec<Pair>], estimate: &[usize], [std_m, error_m]: [f64; 2], held_out_gains: Vec<f64>) -> Found {
    Found {
        status: Status::Named,
        causes: vec![Cause::GroundError],
        parameters: vec![parameter(Quantity::StdM, std_m, error_m)],
        confidence: 1.0,
        channel: Channel::Residuals,
        covariate: Covariate::Place,
        held_out_gains,
        says: format!(
            "the ground is not where the simulation has it: {:.1} cm higher or lower from place to place, beyond a plane",
            std_m * 100.0
        ),
        separate_by: None,
        curve: curve(pairs, estimate),
        effects: vec![],
    }
}

/// Points of the plot.
const BINS: usize = 12;

/// Heights of the same places in other frames over those in one.
fn curve(pairs: &[Vec<Pair>], estimate: &[usize]) -> Curve {
    let mut all: Vec<Pair> = estimate.iter().flat_map(|&f| pairs[f].clone()).collect();
    all.sort_by(|a, b| a[1].total_cmp(&b[1]));
    let point = |chunk: &[Pair]| {
        let n = chunk.len() as f64;
        let [measured, x] = [0, 1].map(|k: usize| chunk.iter().map(|p| p[k]).sum::<f64>() / n);
        let variance = chunk.iter().map(|p| (p[0] - measured).powi(2)).sum::<f64>() / n;
        CurvePoint { sensor: 0, x, measured, before: 0.0, after: 0.0, error: (variance / n).sqrt() }
    };
    Curve {
        x: "height of the same place in another frame, m".into(),
        y: "height of the ground over the simulated one, m".into(),
        by_sensor: false,
        points: all.chunks(all.len().div_ceil(BINS).max(1)).map(point).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::channels::motion::OwnMotion;
    use crate::inference::roles::roles;
    use crate::pairing::Ray;
    use nalgebra::Vector3;
    use sensor::Rig;

    /// A vehicle that drives 1.5 m from frame to frame and turns slowly; heights of the ground by the place in the
    /// world and by the place in the vehicle's axes, in a frame.
    fn found_in(height_m: impl Fn(Vector2<f64>, Vector2<f64>, usize) -> f64) -> ChannelResult {
        let (frames, speed, turn, dt) = (60, 15.0, 0.1, 0.1);
        let (mut at, mut heading) = (Vector2::zeros(), 0.0);
        let mut recorded = Vec::new();
        for f in 0..frames {
            let mut rays = Vec::new();
            for k in 0..6000 {
                let (azimuth, distance) = (2.4 * f64::from(k), 4.0 + 18.0 * f64::from(k) / 6000.0);
                let own = Vector2::new(azimuth.cos(), azimuth.sin()) * distance;
                let up_m = height_m(at + Rotation2::new(heading) * own, own, f);
                let place = Vector3::new(own.x, own.y, -2.0);
                let cos = 2.0 / place.norm();
                rays.push(Ray {
                    surface: Surface::Ground,
                    normal: [0.0, 0.0, 1.0],
                    cos_incidence: cos as f32,
                    residual_m: (-up_m / cos) as f32,
                    ..Ray::standing(&place)
                });
            }
            recorded.push(FramePair::of_rays(f.to_string(), rays, vec![]));
            at += Rotation2::new(heading + 0.5 * turn * dt) * Vector2::new(speed * dt, 0.0);
            heading += turn * dt;
        }
        let turn_rate_rad_s = Vector3::new(0.0, 0.0, turn);
        let own = OwnMotion { velocity_m_s: Vector3::new(speed, 0.0, 0.0), turn_rate_rad_s };
        let context = Context {
            rig: &Rig::single(),
            frames: &recorded,
            roles: roles(frames),
            times: Some((0..frames).map(|f| dt * f as f64).collect()),
            motion: None,
            to_next: vec![Some(own); frames - 1],
        };
        search(&context)
    }

    fn wave(place: Vector2<f64>) -> f64 {
        0.02 * (0.35 * place.x).sin() * (0.25 * place.y + 1.0).cos()
    }

    #[test]
    fn ground_that_rolls_where_it_is_has_a_name_and_its_height() {
        let result = found_in(|world, _, _| wave(world));
        let [found] = &result.found[..] else { panic!("{:?}", result.considered) };
        let std_m = found.parameter(Quantity::StdM).unwrap().estimate;
        assert!(found.is(Cause::GroundError) && (0.006..0.011).contains(&std_m), "{std_m}");
    }

    #[test]
    fn what_moves_with_the_vehicle_or_vibrates_is_no_ground() {
        assert!(found_in(|_, own, _| wave(own)).found.is_empty());
        // Alike in two frames that are compared, which are three apart.
        assert!(found_in(|_, own, f| wave(own) * (std::f64::consts::TAU * f as f64 / 3.0).cos()).found.is_empty());
    }
}
