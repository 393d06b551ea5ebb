//! Patches of directions that lose more than others. No cause of the catalogue: dirt on a window, a scratch, a reflection.

use super::{Context, Found, Z_STAR, parameter};
use crate::channels::hits::{hit_frames, total};
use crate::channels::mask::{AZIMUTH_RAD, ELEVATION_RAD, Mask, with_neighbours};
use crate::channels::patch::{DirectionLosses, Losses, Patch, direction_losses, patches, share_of_spot, spot};
use crate::diagnosis::{Curve, CurvePoint, Status};
use crate::inference::choice::total_and_z;
use crate::inference::law::Law;
use crate::inference::losses::LossTable;
use crate::inference::roles::Role;
use crate::search::hits::refit;
use rayon::prelude::*;
use statistics::{blocks_of, draw_blocks};
use std::collections::{BTreeMap, BTreeSet};

/// At most so many are spoken of.
const MOST: usize = 3;

/// Share of all simulated returns that a patch must lose, and of its own.
const FLOOR: [f64; 2] = [3e-4, 0.08];

/// Draws of blocks for intervals.
const REPETITIONS: usize = 200;

/// The search; what is found is hidden from the search for laws.
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
        // Other frames decide whether it is there.
        let each: Vec<Losses> = of_estimate.iter().map(|l| patch.sum(l)).collect();
        let lost: Vec<f64> = each.iter().map(Losses::lost).collect();
        let (all, z) = total_and_z(&lost);
        let share = all / each.iter().map(Losses::simulated).sum::<f64>().max(1.0);
        if z < Z_STAR || all < FLOOR[0] * returns || share < FLOOR[1] {
            continue;
        }
        let held = of_hold_out.iter().map(|l| gain(&patch.sum(l), share));
        found.push(put(context, &patch, &estimate, &blocks, &of_estimate, held.collect()));
        hidden.extend(with_neighbours(&patch.cells));
    }
    mask.around.extend(hidden);
    found
}

/// Nats by a share that is lost, where the simulation loses nothing but what is usual.
fn gain(losses: &Losses, share: f64) -> f64 {
    let lost = losses.lost().clamp(0.0, losses.simulated());
    let usual = 0.02;
    let told = (usual + share).min(0.98);
    lost * (told / usual).ln() + (losses.simulated() - lost) * ((1.0 - told) / (1.0 - usual)).ln()
}

fn put(
    context: &Context,
    patch: &Patch,
    estimate: &[usize],
    blocks: &[usize],
    of_estimate: &[DirectionLosses],
    held_out_gains: Vec<f64>,
) -> Found {
    let together = |which: &[usize]| {
        let mut all = DirectionLosses::new();
        for &i in which {
            patch.cells.iter().filter_map(|c| Some((c, of_estimate[i].get(c)?))).for_each(|(c, l)| {
                all.entry(*c).or_default().add(l);
            });
        }
        all
    };
    let members = blocks_of(blocks);
    let mut rng = data::stream(0, "diagnose patch", 0, 0);
    let everything: Vec<usize> = (0..estimate.len()).collect();
    let estimates = spot(&together(&everything), patch);
    let draws: Vec<[f64; 4]> =
        (0..REPETITIONS).map(|_| spot(&together(&draw_blocks(&members, &mut rng)), patch)).collect();
    let error = |k: usize| {
        let mean = draws.iter().map(|d| d[k]).sum::<f64>() / draws.len() as f64;
        (draws.iter().map(|d| (d[k] - mean).powi(2)).sum::<f64>() / draws.len() as f64).sqrt()
    };
    let sensor = patch.cells.first().map_or(0, |c| c.0);
    let name = &context.rig.sensors[usize::from(sensor)].name;
    let [azimuth, elevation, radius] = [0, 1, 2].map(|k| estimates[k].to_degrees());
    // Cells have a size, and spots have an edge of their own.
    let degrees = |label: &str, value: f64, k: usize, form: f64| {
        parameter(
            label,
            value,
            error(k).to_degrees().hypot(0.3 * ELEVATION_RAD.to_degrees()).hypot(form * value),
            "deg",
        )
    };
    let number = parameter("sensor", f64::from(sensor), 0.0, "number");
    let rows: BTreeSet<i32> = patch.cells.iter().map(|c| c.2).collect();
    // By azimuth, over the rows of the patch: what is lost, and what the spot would lose.
    let mut columns = BTreeMap::<i32, (Losses, f64)>::new();
    for (cell, losses) in of_estimate.iter().flatten().filter(|(c, _)| c.0 == sensor && rows.contains(&c.2)) {
        let (all, told) = columns.entry(cell.1).or_default();
        all.add(losses);
        *told += losses.simulated() * share_of_spot(&estimates, cell);
    }
    let points = columns.iter().filter(|(_, (l, _))| l.simulated() >= 20.0).map(|(azimuth, (l, told))| {
        let lost = l.share().clamp(0.0, 1.0);
        CurvePoint {
            x: ((f64::from(*azimuth) + 0.5) * AZIMUTH_RAD).to_degrees(),
            measured: 1.0 - lost,
            before: 1.0,
            after: 1.0 - told / l.simulated(),
            error: ((lost + 0.02) / l.simulated()).sqrt(),
        }
    });
    Found {
        status: Status::Unexplained,
        causes: vec![],
        family: "unknown",
        parameters: vec![
            number,
            degrees("azimuth_deg", azimuth, 0, 0.0),
            degrees("elevation_deg", elevation, 1, 0.0),
            degrees("radius_deg", radius, 2, 0.1),
            parameter("share", estimates[3], error(3).hypot(0.1 * estimates[3]), "1"),
        ],
        confidence: 1.0,
        channel: "hits",
        covariate: "direction".into(),
        held_out_gains,
        says: format!(
            "sensor {name} loses up to {:.0} % of the returns of a patch of directions, {radius:.0} degrees about azimuth {azimuth:.0} and elevation {elevation:.0}, that come back from surfaces like them elsewhere: as dirt on its window would do; no cause of the catalogue does that",
            100.0 * estimates[3]
        ),
        separate_by: None,
        curve: Curve {
            x: "azimuth, degrees".into(),
            y: format!("share that comes back, of what is usual, at {:.0} degrees of elevation", {
                let middle = rows.iter().map(|r| f64::from(*r) + 0.5).sum::<f64>() / rows.len().max(1) as f64;
                (middle * ELEVATION_RAD).to_degrees()
            }),
            points: points.collect(),
        },
    }
}
