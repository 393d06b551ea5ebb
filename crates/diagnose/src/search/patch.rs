//! Patches of directions that lose more than others: dirt or a scratch on a sensor's window.

use super::{Context, Found, NamedParameter, Z_STAR, parameter, sensor_number};
use crate::catalogue::{Cause, Channel, Covariate, Quantity};
use crate::channels::hits::{hit_frames, total};
use crate::channels::mask::{AZIMUTH_RAD, ELEVATION_RAD, Mask, with_neighbours};
use crate::channels::patch::{DirectionLosses, Losses, Patch, direction_losses, patches, share_of_spot, spot};
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

/// Smallest loss of a patch that is reported: as a share of all simulated returns, and of those of the patch.
const FLOOR: [f64; 2] = [3e-4, 0.08];

/// Share of the returns that are lost in any direction.
const USUAL_LOSS: f64 = 0.02;

/// Bootstrap repetitions for intervals.
const REPETITIONS: usize = 200;

/// Simulated returns that a point of the plot needs.
const FEWEST: f64 = 20.0;

/// The search. Patches that are found are hidden from the search for laws.
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
    let returns = context.returns(&estimate);
    let mut found = Vec::new();
    let mut hidden = BTreeSet::new();
    for patch in candidates.into_iter().take(MOST) {
        // Significance is judged on other frames than those that gave the patch.
        let each: Vec<Losses> = of_estimate.iter().map(|l| patch.sum(l)).collect();
        let lost: Vec<f64> = each.iter().map(Losses::lost).collect();
        let (all, z) = total_and_z(&lost);
        let share = all / each.iter().map(Losses::simulated).sum::<f64>().max(1.0);
        if z < Z_STAR || all < FLOOR[0] * returns || share < FLOOR[1] {
            continue;
        }
        let held = of_hold_out.iter().map(|l| gain(&patch.sum(l), share));
        found.push(describe(context, &patch, &blocks, &of_estimate, held.collect()));
        hidden.extend(with_neighbours(&patch.cells));
    }
    mask.around.extend(hidden);
    found
}

/// Gain by a lost share over the usual loss, nats.
fn gain(losses: &Losses, share: f64) -> f64 {
    let lost = losses.lost().clamp(0.0, losses.simulated());
    let expected = (USUAL_LOSS + share).min(0.98);
    lost * (expected / USUAL_LOSS).ln() + (losses.simulated() - lost) * ((1.0 - expected) / (1.0 - USUAL_LOSS)).ln()
}

/// The finding of a patch.
fn describe(
    context: &Context,
    patch: &Patch,
    blocks: &[usize],
    of_estimate: &[DirectionLosses],
    held_out_gains: Vec<f64>,
) -> Found {
    let everything: Vec<usize> = (0..of_estimate.len()).collect();
    let spot = spot(&sum_of(patch, of_estimate, &everything), patch);
    let sensor = patch.cells.first().map_or(0, |c| usize::from(c.0));
    let name = &context.rig.sensors[sensor].name;
    let [azimuth, elevation, radius] = [0, 1, 2].map(|k| spot[k].to_degrees());
    Found {
        effects: Vec::new(),
        status: Status::Named,
        causes: vec![Cause::DirtyWindow],
        parameters: parameters(patch, blocks, of_estimate, sensor, spot),
        confidence: 1.0,
        channel: Channel::Hits,
        covariate: Covariate::Direction,
        held_out_gains,
        says: format!(
            "sensor {name} loses up to {:.0} % of the returns of a patch of directions, {radius:.0} degrees about azimuth {azimuth:.0} and elevation {elevation:.0}, that come back from surfaces like them elsewhere: dirt on its window does that",
            100.0 * spot[3]
        ),
        separate_by: None,
        curve: curve(patch, of_estimate, &spot),
    }
}

/// Losses in the directions of a patch over some frames.
fn sum_of(patch: &Patch, of_frames: &[DirectionLosses], which: &[usize]) -> DirectionLosses {
    let mut all = DirectionLosses::new();
    for &i in which {
        patch.cells.iter().filter_map(|c| Some((c, of_frames[i].get(c)?))).for_each(|(c, l)| {
            all.entry(*c).or_default().add(l);
        });
    }
    all
}

/// Middle, radius and loss of a spot, with intervals from a bootstrap over blocks of frames. The size of a cell and
/// the unknown profile of the edge add to the errors.
fn parameters(
    patch: &Patch,
    blocks: &[usize],
    of_estimate: &[DirectionLosses],
    sensor: usize,
    estimates: [f64; 4],
) -> Vec<NamedParameter> {
    let members = blocks_of(blocks);
    let mut rng = data::stream(0, "diagnose patch", 0, 0);
    let draws: Vec<[f64; 4]> =
        (0..REPETITIONS).map(|_| spot(&sum_of(patch, of_estimate, &draw_blocks(&members, &mut rng)), patch)).collect();
    let error = |k: usize| deviation(&draws.iter().map(|d| d[k]).collect::<Vec<_>>());
    let degrees = |quantity, k: usize, form: f64| {
        let value = estimates[k].to_degrees();
        let of_cells = error(k).to_degrees().hypot(0.3 * ELEVATION_RAD.to_degrees());
        parameter(quantity, value, of_cells.hypot(form * value))
    };
    vec![
        sensor_number(sensor),
        degrees(Quantity::AzimuthDeg, 0, 0.0),
        degrees(Quantity::ElevationDeg, 1, 0.0),
        degrees(Quantity::RadiusDeg, 2, 0.1),
        parameter(Quantity::Share, estimates[3], error(3).hypot(0.1 * estimates[3])),
    ]
}

/// Share of the usual returns that come back along the azimuth, over the rows of a patch; after: with the spot.
fn curve(patch: &Patch, of_estimate: &[DirectionLosses], spot: &[f64; 4]) -> Curve {
    let sensor = patch.cells.first().map_or(0, |c| c.0);
    let rows: BTreeSet<i32> = patch.cells.iter().map(|c| c.2).collect();
    let mut columns = BTreeMap::<i32, (Losses, f64)>::new();
    for (cell, losses) in of_estimate.iter().flatten().filter(|(c, _)| c.0 == sensor && rows.contains(&c.2)) {
        let (all, expected) = columns.entry(cell.1).or_default();
        all.add(losses);
        *expected += losses.simulated() * share_of_spot(spot, cell);
    }
    let points = columns.iter().filter(|(_, (l, _))| l.simulated() >= FEWEST).map(|(azimuth, (l, expected))| {
        let lost = l.share().clamp(0.0, 1.0);
        CurvePoint {
            sensor: 0,
            x: ((f64::from(*azimuth) + 0.5) * AZIMUTH_RAD).to_degrees(),
            measured: 1.0 - lost,
            before: 1.0,
            after: 1.0 - expected / l.simulated(),
            error: ((lost + 0.02) / l.simulated()).sqrt(),
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
