//! Second returns: shots of which one side reports two ranges, and the other one.

use super::{ChannelResult, Context, Found, NamedParameter, Z_STAR, with_error};
use crate::catalogue::sizes::SECOND_SHARE;
use crate::catalogue::{Cause, Channel, Covariate, Quantity, Unit};
use crate::curve::{Curve, CurvePoint};
use crate::diagnosis::{Considered, Minimum, Parameter, Status};
use crate::error::DiagnoseError;
use crate::inference::choice::total_and_z;
use crate::inference::counts::gain_of_count;
use crate::inference::roles::Role;
use crate::pairing::FramePair;

/// Share of second returns that chance may make, for gains.
const BY_CHANCE: f64 = 1e-4;

/// Widest beam of a LiDAR, rad.
const WIDEST_RAD: f64 = 0.02;

/// The search. `mixed_per_rad` is the share of the simulated returns of a frame that beams would mix, see
/// [`crate::pairing::mixed_per_rad`].
///
/// # Errors
/// Those of `mixed_per_rad`.
pub fn search(
    context: &Context,
    mixed_per_rad: impl Fn(usize) -> Result<f64, DiagnoseError>,
) -> Result<ChannelResult, DiagnoseError> {
    let [select, estimate, hold_out] = [Role::Select, Role::Estimate, Role::HoldOut].map(|r| context.of(r));
    let mut result = ChannelResult::new(Channel::Returns, hold_out.len());
    let differences = |of: &[usize]| of.iter().map(|&i| difference(&context.frames[i])).collect::<Vec<f64>>();
    let (total, z) = total_and_z(&differences(&select));
    let more = total / select.len().max(1) as f64;
    let chosen = more.abs() > SECOND_SHARE && z.abs() > Z_STAR;
    result.considered.push(Considered {
        cause: Cause::DualReturns.into(),
        channel: Channel::Returns,
        nats_per_ray: 0.0,
        z,
        outcome: if chosen { "chosen" } else { "both sides have as many second returns" }.into(),
    });
    result.minimum.push((Cause::DualReturns, Minimum::new(Quantity::Share, SECOND_SHARE)));
    if !chosen {
        return Ok(result);
    }
    let each = differences(&estimate);
    let (total, z) = total_and_z(&each);
    let more = total / each.len().max(1) as f64;
    let held: Vec<f64> = hold_out.iter().map(|&i| gain(&context.frames[i])).collect();
    result.distance.iter_mut().zip(&held).for_each(|(d, g)| *d = [*g; 3]);
    let mixed = estimate.iter().map(|&i| mixed_per_rad(i)).collect::<Result<Vec<f64>, _>>()?;
    let says = match more > 0.0 {
        true => format!(
            "{:.1} % of the measured shots have a second return behind the first; your simulator has one return a shot",
            100.0 * more
        ),
        false => format!("your simulator has a second return of {:.1} % more shots than were measured", -100.0 * more),
    };
    result.found.push(Found {
        status: Status::Named,
        causes: vec![Cause::DualReturns],
        parameters: parameters(statistics::mean(&mixed), more, more.abs() / z.abs().max(1e-9)),
        confidence: 1.0,
        channel: Channel::Returns,
        covariate: Covariate::Edge,
        held_out_gains: held,
        says,
        separate_by: None,
        curve: curve(context, &estimate),
        effects: Vec::new(),
    });
    Ok(result)
}

/// Interval of the width of beams as multiples of the width of those that report each second surface they meet. A
/// receiver reports one on which enough light falls, and some sensors not each of them: beams are wider. The least is
/// for the errors of the gaps that are counted.
const WIDER: [f64; 2] = [0.75, 4.0];

/// The share of second returns, and the full width of a beam that meets two surfaces as often, where a share `mixed`
/// of the returns does so for each radian.
fn parameters(mixed: f64, more: f64, error: f64) -> Vec<NamedParameter> {
    let mut parameters = vec![(Quantity::Share.into(), with_error(more, error, Unit::One))];
    if more > 0.0 && mixed > 0.0 {
        let width = (more / mixed).min(WIDEST_RAD);
        let ci95 = WIDER.map(|times| times * width);
        parameters.push((Quantity::DivergenceRad.into(), Parameter { estimate: width, unit: Unit::Radian, ci95 }));
    }
    parameters
}

/// Shares of the shots of both sides that have a second return.
fn shares(frame: &FramePair) -> [f64; 2] {
    let share = |second: f64, first: usize| second / (first.max(1) as f64);
    [share(frame.second[0], frame.measured.len()), share(frame.second[1], frame.simulated.len())]
}

fn difference(frame: &FramePair) -> f64 {
    let [measured, simulated] = shares(frame);
    measured - simulated
}

/// Gain of a frame by its own share of second returns over that of the other side, nats.
fn gain(frame: &FramePair) -> f64 {
    let [measured, simulated] = shares(frame).map(|share| share.max(BY_CHANCE));
    gain_of_count(frame.second[0], frame.measured.len() as f64, measured, simulated)
}

/// Share of the shots with a second return, frame by frame.
fn curve(context: &Context, frames: &[usize]) -> Curve {
    let point = |(k, &i): (usize, &usize)| {
        let [measured, before] = shares(&context.frames[i]);
        let error = (measured / context.frames[i].measured.len().max(1) as f64).sqrt();
        CurvePoint { sensor: 0, x: k as f64, measured, before, after: measured, error }
    };
    Curve {
        x: "frame".into(),
        y: "share of the shots with a second return".into(),
        by_sensor: false,
        points: frames.iter().enumerate().map(point).collect(),
    }
}
