//! Patches of directions that lose more than others: dirt or a scratch on a sensor's window.

use super::{Context, Found, NamedParameter, Z_STAR, parameter, sensor_number};
use crate::catalogue::sizes::{PATCH_LOST, PATCH_SHARE};
use crate::catalogue::{Cause, Channel, Covariate, Quantity};
use crate::channels::hits::{hit_frames, total};
use crate::channels::mask::{AZIMUTH_RAD, DirectionCell, ELEVATION_RAD, Mask};
use crate::channels::patch::{self, DirectionLosses, Losses, Patch, direction_losses, patches};
use crate::channels::spot::{Spot, USUAL_LOSS};
use crate::curve::{Curve, CurvePoint};
use crate::diagnosis::Status;
use crate::inference::choice::total_and_z;
use crate::inference::law::Law;
use crate::inference::losses::LossTable;
use crate::inference::roles::Role;
use crate::search::hits::refit;
use rayon::prelude::*;
use statistics::{blocks_of, deviation, draw_blocks};
use std::collections::{BTreeMap, BTreeSet};

/// Largest number of patches that are reported.
const MOST: usize = 3;

/// Largest scatter of the share that a window takes over blocks of frames, whose surfaces return less or more light.
const SCATTER: f64 = 0.25;

/// Bootstrap repetitions for intervals.
const REPETITIONS: usize = 200;

/// Simulated returns that a point of the plot needs.
const FEWEST: f64 = 20.0;

/// The search. Patches that are found are hidden from the search for laws. Those that let nothing through are parts of
/// the ego vehicle, and are added to what the mask hides.
pub(super) fn search(context: &Context, mask: &mut Mask) -> Vec<Found> {
    let [select, estimate, hold_out] = [Role::Select, Role::Estimate, Role::HoldOut].map(|r| context.of(r));
    let hits = hit_frames(context.frames, mask);
    let table = LossTable::new(total(select.iter().map(|&i| &hits[i])));
    let usual = table.unmatched(&refit(&table, &[Law::Random, Law::Signal]));
    let losses = |which: &[usize]| direction_losses(context.frames, which, mask, &usual);
    let candidates = patches(&losses(&select));
    if candidates.is_empty() {
        return vec![];
    }
    let each = |frames: &[usize]| frames.par_iter().map(|&f| losses(&[f])).collect::<Vec<DirectionLosses>>();
    let (of_estimate, of_hold_out) = (each(&estimate), each(&hold_out));
    let blocks = context.blocks(&estimate);
    let all = sum_of(of_estimate.iter().flatten());
    let returns = context.returns(&estimate);
    let mut found = Vec::new();
    for patch in candidates {
        // Significance is judged on other frames than those that gave the patch.
        let of_frames: Vec<Losses> = of_estimate.iter().map(|l| patch.sum(l)).collect();
        let of_block = |members: &Vec<usize>| patch::total(members.iter().map(|&i| &of_frames[i]));
        let of_blocks: Vec<Losses> = blocks_of(&blocks).iter().map(of_block).collect();
        let together = patch::total(of_blocks.iter());
        let enough = together.lost() >= PATCH_SHARE * returns && together.share() >= PATCH_LOST;
        let (_, z) = total_and_z(&of_frames.iter().map(Losses::lost).collect::<Vec<_>>());
        if !enough || z < Z_STAR || !is_constant(&of_blocks) {
            continue;
        }
        let spot = Spot::fit(&all, &patch, None);
        if !spot.has_ends() {
            continue;
        }
        let cells = spot.cells(patch.sensor());
        mask.around.extend(&cells);
        if spot.is_opaque() {
            mask.hide(cells.into_iter().map(|cell| (cell, spot.share(&cell))));
            continue;
        }
        let held = of_hold_out.iter().map(|l| gain(&patch.sum(l), together.share()));
        found.push(describe(context, &patch, &spot, &blocks, &of_estimate, held.collect()));
        if found.len() == MOST {
            break;
        }
    }
    found
}

/// Whether blocks of frames lose the same share of what the usual losses leave, within [`SCATTER`] and three standard
/// deviations of chance: what is on a window is there at all times, whatever stands before it.
fn is_constant(blocks: &[Losses]) -> bool {
    let share = patch::total(blocks.iter()).share().clamp(0.0, 1.0);
    let squares = blocks.iter().map(|block| {
        let expected = share * block.left();
        let variance = expected * (1.0 - share) + (SCATTER * expected).powi(2);
        (block.lost() - expected).powi(2) / variance.max(1.0)
    });
    let free = blocks.len() as f64 - 1.0;
    squares.sum::<f64>() <= free + 3.0 * (2.0 * free).sqrt()
}

/// Gain by a lost share over the usual loss, nats.
fn gain(losses: &Losses, share: f64) -> f64 {
    let lost = losses.lost().clamp(0.0, losses.left());
    let expected = (USUAL_LOSS + share).min(0.98);
    lost * (expected / USUAL_LOSS).ln() + (losses.left() - lost) * ((1.0 - expected) / (1.0 - USUAL_LOSS)).ln()
}

/// The finding of a patch.
fn describe(
    context: &Context,
    patch: &Patch,
    spot: &Spot,
    blocks: &[usize],
    of_estimate: &[DirectionLosses],
    held_out_gains: Vec<f64>,
) -> Found {
    let sensor = usize::from(patch.sensor());
    let name = &context.rig.sensors[sensor].name;
    let [azimuth, elevation] = spot.middle.map(f64::to_degrees);
    let [width, height] = spot.radius.map(|r| 2.0 * r.to_degrees());
    Found {
        effects: Vec::new(),
        status: Status::Named,
        causes: vec![Cause::DirtyWindow],
        parameters: parameters(patch, spot, blocks, of_estimate),
        confidence: 1.0,
        channel: Channel::Hits,
        covariate: Covariate::Direction,
        held_out_gains,
        says: format!(
            "sensor {name} loses up to {:.0} % of the returns of a patch of directions, {width:.0} degrees wide and {height:.0} high, about azimuth {azimuth:.0} and elevation {elevation:.0}, that come back from surfaces like them elsewhere: dirt on its window does that",
            100.0 * spot.most
        ),
        separate_by: None,
        curve: curve(patch, of_estimate, spot),
    }
}

/// Sums of losses by direction.
fn sum_of<'a>(losses: impl Iterator<Item = (&'a DirectionCell, &'a Losses)>) -> DirectionLosses {
    let mut all = DirectionLosses::new();
    losses.for_each(|(c, l)| all.entry(*c).or_default().add(l));
    all
}

/// Middle, form and loss of a spot, with intervals from a bootstrap over blocks of frames. The size of a cell and a
/// profile of another form add to the errors.
fn parameters(patch: &Patch, spot: &Spot, blocks: &[usize], of_estimate: &[DirectionLosses]) -> Vec<NamedParameter> {
    let numbers = |s: &Spot| [s.middle[0], s.middle[1], s.radius[1], s.aspect(), s.sharpness, s.most];
    let members = blocks_of(blocks);
    let mut rng = data::stream(0, "diagnose patch", 0, 0);
    let drawn: Vec<Vec<usize>> = (0..REPETITIONS).map(|_| draw_blocks(&members, &mut rng)).collect();
    let near = |frame: &DirectionLosses| -> DirectionLosses {
        frame.iter().filter(|(c, _)| c.0 == patch.sensor() && spot.is_near(c)).map(|(c, l)| (*c, *l)).collect()
    };
    let of_frames: Vec<DirectionLosses> = of_estimate.iter().map(near).collect();
    let refit = |which: &Vec<usize>| {
        let losses = sum_of(which.iter().flat_map(|&i| &of_frames[i]));
        numbers(&Spot::fit(&losses, patch, Some(spot)))
    };
    let draws: Vec<[f64; 6]> = drawn.par_iter().map(refit).collect();
    let error = |k: usize| deviation(&draws.iter().map(|d| d[k]).collect::<Vec<_>>());
    let estimates = numbers(spot);
    let degrees = |quantity, k: usize, form: f64| {
        let value = estimates[k].to_degrees();
        let of_cells = error(k).to_degrees().hypot(0.3 * ELEVATION_RAD.to_degrees());
        parameter(quantity, value, of_cells.hypot(form * value))
    };
    let number = |quantity, k: usize| parameter(quantity, estimates[k], error(k).hypot(0.1 * estimates[k]));
    vec![
        sensor_number(usize::from(patch.sensor())),
        degrees(Quantity::AzimuthDeg, 0, 0.0),
        degrees(Quantity::ElevationDeg, 1, 0.0),
        degrees(Quantity::RadiusDeg, 2, 0.1),
        number(Quantity::Aspect, 3),
        number(Quantity::Sharpness, 4),
        number(Quantity::Share, 5),
    ]
}

/// Share of the usual returns that come back along the azimuth, over the rows of a patch; after: with the spot.
fn curve(patch: &Patch, of_estimate: &[DirectionLosses], spot: &Spot) -> Curve {
    let sensor = patch.sensor();
    let rows: BTreeSet<i32> = patch.cells.iter().map(|c| c.2).collect();
    let mut columns = BTreeMap::<i32, (Losses, f64)>::new();
    for (cell, losses) in of_estimate.iter().flatten().filter(|(c, _)| c.0 == sensor && rows.contains(&c.2)) {
        let (all, expected) = columns.entry(cell.1).or_default();
        all.add(losses);
        *expected += losses.left() * spot.share(cell);
    }
    let points = columns.iter().filter(|(_, (l, _))| l.left() >= FEWEST).map(|(azimuth, (l, expected))| {
        let lost = l.share().clamp(0.0, 1.0);
        CurvePoint {
            sensor: 0,
            x: ((f64::from(*azimuth) + 0.5) * AZIMUTH_RAD).to_degrees(),
            measured: 1.0 - lost,
            before: 1.0,
            after: 1.0 - expected / l.left(),
            error: ((lost + USUAL_LOSS) / l.left()).sqrt(),
        }
    });
    let middle = rows.iter().map(|r| f64::from(*r) + 0.5).sum::<f64>() / rows.len().max(1) as f64;
    let middle_deg = (middle * ELEVATION_RAD).to_degrees();
    Curve {
        x: "azimuth, degrees".into(),
        y: format!("share that comes back, of what is usual, at {middle_deg:.0} degrees of elevation"),
        by_sensor: false,
        points: points.collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_on_a_window_takes_the_same_share_at_all_times() {
        let blocks = |shares: &[f64]| shares.iter().map(|s| Losses::of(100.0, 100.0 * s)).collect::<Vec<_>>();
        assert!(is_constant(&blocks(&[0.59, 0.56, 0.58, 0.58, 0.55, 0.56, 0.63, 0.54])));
        assert!(is_constant(&blocks(&[0.3, 0.5, 0.4, 0.35, 0.45, 0.5, 0.42, 0.3])), "darker surfaces in some");
        assert!(!is_constant(&blocks(&[0.5, 0.5, 0.45, 0.21, 0.01, 0.06, 0.05, 0.04])), "a surface passes");
    }
}
