//! Ground that is not where the simulation has it, place by place. What is amiss with the sensor or with the vehicle is
//! the same in the vehicle's axes, or changes from frame to frame; the ground is the same where it is, and the vehicle
//! passes over it.

use crate::catalogue::sizes::DISPLACED_M;
use crate::catalogue::{Cause, Channel, Covariate, Quantity};
use crate::channels::heights::{Cell, common_std, heights, largest_of_ground};
use crate::curve::{Curve, means};
use crate::diagnosis::{Minimum, Status};
use crate::inference::choice::total_and_z;
use crate::inference::linear::{LinearFrame, cross_gains, fit};
use crate::inference::roles::Role;
use crate::search::{ChannelResult, Context, Found, first_demands, parameter};
use nalgebra::{DMatrix, DVector, Rotation2, Vector2};

/// Width of a cell of the ground, m.
const CELL_M: f64 = 2.0;

/// Least way between two frames that are compared, m: farther than what is the same in the vehicle's axes reaches.
const LEAST_WAY_M: f64 = 4.0;

/// Longest way between them, m.
const MOST_WAY_M: f64 = 15.0;

/// The search, on frames with what is known of the sensor undone. Without the way from frame to frame nothing is known.
pub fn search(context: &Context) -> ChannelResult {
    let [select, estimate, hold_out] = [Role::Select, Role::Estimate, Role::HoldOut].map(|role| context.of(role));
    let mut result = ChannelResult::new(Channel::Residuals, hold_out.len());
    let Some(pairs) = pairs(context) else { return result };
    let sums: Vec<LinearFrame> = pairs.iter().map(|pairs| sums(pairs)).collect();
    let on = |which: &[usize]| which.iter().map(|&f| &sums[f]).collect::<Vec<_>>();
    let gains = gains_of_places(&on(&select), &context.blocks(&select));
    let (total, z) = total_and_z(&gains);
    let [on_select, on_estimate] = [&select, &estimate].map(|which| std_m(&pairs, which, &context.blocks(which)));
    // Surfaces of a model lie beside the real ones by as much as the floor.
    let outcome = outcome((total, z), [on_select, on_estimate], DISPLACED_M);
    result.consider(Cause::GroundError, (total, z), context.returns(&select), outcome);
    result.minimum.push((Cause::GroundError, Minimum::new(Quantity::StdM, DISPLACED_M)));
    if outcome == "chosen" {
        let [fitted, without] =
            [&BOTH[..], &BOTH[1..]].map(|columns| fit(&on(&estimate), &context.blocks(&estimate), columns, &PRIOR));
        let gains: Vec<f64> = hold_out.iter().map(|&f| fitted.gain(&sums[f]) - without.gain(&sums[f])).collect();
        result.distance = gains.iter().map(|g| [g.max(0.0), *g, *g]).collect();
        result.found.push(found(&pairs, &estimate, on_estimate, gains));
    }
    result
}

/// What becomes of a standard deviation with its error, on the selecting and on the estimating frames, by the gain with
/// its z, and by the smallest one that is reported.
pub(super) fn outcome((nats, z): (f64, f64), [on_select, on_estimate]: [[f64; 2]; 2], smallest: f64) -> &'static str {
    let demands = first_demands();
    let large = on_select[0] > smallest && on_estimate[0] - 1.96 * on_estimate[1] > smallest;
    match (nats > demands.nats && z > demands.z, large) {
        (false, _) => "no gain on frames that it was not fitted on",
        (true, false) => "too small to speak of",
        (true, true) => "chosen",
    }
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
    let mut heights = heights(context.frames, context.rig, |_, place| cell_of(place));
    // The ground rolls everywhere, things stand in some places.
    let most_m = largest_of_ground(heights.iter().flat_map(|frame| frame.values().map(|[height_m, _]| *height_m)));
    heights.iter_mut().for_each(|frame| frame.retain(|_, [height_m, _]| height_m.abs() <= most_m));
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

fn cell_of(place: &Vector2<f64>) -> Cell {
    [place.x, place.y].map(|v| (v / CELL_M).floor() as i32)
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

/// Standard deviation of the heights that two frames agree on, m, with its error.
fn std_m(pairs: &[Vec<Pair>], which: &[usize], blocks: &[usize]) -> [f64; 2] {
    let of_frame =
        |f: usize| pairs[f].iter().fold([0.0; 2], |s, [own_m, place_m, ..]| [s[0] + 1.0, s[1] + own_m * place_m]);
    common_std(which.iter().zip(blocks).map(|(&f, block)| (*block, of_frame(f))))
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

/// Heights of the same places in other frames over those in one.
fn curve(pairs: &[Vec<Pair>], estimate: &[usize]) -> Curve {
    let heights = |&f: &usize| pairs[f].iter().map(|[own_m, place_m, ..]| [*place_m, *own_m]);
    Curve {
        x: "height of the same place in another frame, m".into(),
        y: "height of the ground over the simulated one, m".into(),
        by_sensor: false,
        points: means(estimate.iter().flat_map(heights).collect()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::channels::heights::testing::{found_in, wave};

    #[test]
    fn ground_that_rolls_where_it_is_has_a_name_and_its_height() {
        let result = found_in(search, |world, _, _| wave(world));
        let [found] = &result.found[..] else { panic!("{:?}", result.considered) };
        let std_m = found.parameter(Quantity::StdM).unwrap().estimate;
        assert!(found.is(Cause::GroundError) && (0.006..0.011).contains(&std_m), "{std_m}");
    }

    #[test]
    fn what_moves_with_the_vehicle_or_vibrates_is_no_ground() {
        assert!(found_in(search, |_, own, _| wave(own)).found.is_empty());
        // Alike in two frames that are compared, which are three apart.
        let beats = |f: usize| (std::f64::consts::TAU * f as f64 / 3.0).cos();
        assert!(found_in(search, |_, own, f| wave(own) * beats(f)).found.is_empty());
    }
}
