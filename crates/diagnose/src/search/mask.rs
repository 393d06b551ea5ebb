//! What hides rays altogether: an end of the range, parts of the own car. Looked for before laws of losses are weighed.

use super::hits::refit;
use super::{ChannelResult, Context, Found, parameter, patch};
use crate::channels::cells::cell;
use crate::channels::hits::{hit_frames, total};
use crate::channels::mask::{
    AZIMUTH_RAD, DirectionCell, ELEVATION_RAD, Mask, Shown, below, blocked_cells, direction_cell, direction_counts,
    edge_cells, range_cut, with_neighbours,
};
use crate::channels::returns::OWN_CAR_M;
use crate::diagnosis::{Considered, Curve, CurvePoint, Minimum, Parameter, Status};
use crate::inference::choice::UNNAMED;
use crate::inference::law::Law;
use crate::inference::losses::LossTable;
use crate::inference::roles::Role;
use crate::pairing::{FramePair, Ray};
use std::collections::{BTreeMap, BTreeSet};

/// The search; also what is to be left out by the others.
pub fn search(context: &Context, shown: Shown) -> (ChannelResult, Mask) {
    let select = context.of(Role::Select);
    let mut mask = Mask { cut_m: range_cut(context.frames, &select), ..Mask::default() };
    let counts = direction_counts(context.frames, &select);
    // What laws explain is none of it, be they fitted without the dark directions or with them: far ground may be dark all along.
    let dark = blocked_cells(&counts, shown, |_| 1.0);
    let mut fits = vec![expected_shares(context, &select, &mask, &mask)];
    if !dark.is_empty() {
        let without = Mask { around: with_neighbours(&dark), blocked: dark, ..mask.clone() };
        fits.push(expected_shares(context, &select, &mask, &without));
    }
    let expected = |cell: &DirectionCell| {
        let of_fit = |fit: &BTreeMap<DirectionCell, f64>| fit.get(cell).copied().unwrap_or(0.0);
        fits.iter().map(of_fit).fold(f64::INFINITY, f64::min)
    };
    mask.blocked = blocked_cells(&counts, shown, expected);
    let edge = edge_cells(&mask.blocked, &counts, expected);
    let hidden: BTreeSet<DirectionCell> = mask.blocked.union(&edge).copied().collect();
    mask.around = with_neighbours(&hidden.union(&below(&hidden, &counts)).copied().collect());
    let spots = if shown == Shown::Elsewhere { vec![] } else { patch::search(context, &mut mask) };
    let mut result =
        ChannelResult { distance: vec![[0.0; 3]; context.of(Role::HoldOut).len()], ..ChannelResult::default() };
    if let Some(cut) = mask.cut_m {
        result.found.push(cut_found(context, cut));
    }
    if !mask.blocked.is_empty() {
        result.found.push(blocked_found(context, &mask));
    }
    let patched = !spots.is_empty();
    result.found.extend(spots);
    let outcome = |found: bool| if found { "chosen" } else { "no such place" };
    let looked_for =
        [("range_cut", mask.cut_m.is_some()), ("ego_occlusion", !mask.blocked.is_empty()), (UNNAMED, patched)];
    for (cause, found) in looked_for {
        let outcome = outcome(found).into();
        result.considered.push(Considered {
            cause: cause.into(),
            channel: "hits".into(),
            nats_per_ray: 0.0,
            z: 0.0,
            outcome,
        });
    }
    let cell_deg = AZIMUTH_RAD.to_degrees();
    let minimum = Minimum { parameter: "azimuth_width_deg".into(), value: 2.0 * cell_deg, unit: "deg".into() };
    result.minimum.push(("ego_occlusion".into(), minimum));
    for found in &result.found {
        result.distance.iter_mut().zip(&found.held_out_gains).for_each(|(d, g)| (0..3).for_each(|k| d[k] += g));
    }
    (result, mask)
}

/// Share that laws keep in each cell of directions, fitted on what `fitted_without` leaves.
fn expected_shares(
    context: &Context,
    frames: &[usize],
    mask: &Mask,
    fitted_without: &Mask,
) -> BTreeMap<DirectionCell, f64> {
    let hits = hit_frames(context.frames, fitted_without);
    let table = LossTable::new(total(frames.iter().map(|&i| &hits[i])));
    let laws = refit(&table, &[Law::Random, Law::Signal]);
    let mut sums = BTreeMap::<DirectionCell, [f64; 2]>::new();
    for ray in frames.iter().flat_map(|&i| &context.frames[i].simulated) {
        let kept = match cell(ray) {
            _ if mask.hides(ray) => 0.0,
            Some(c) => table.kept(&laws, c),
            // Edges tell nothing of their incidence; whatever lies around them decides.
            None => continue,
        };
        let sum = sums.entry(direction_cell(ray)).or_default();
        sum[0] += kept;
        sum[1] += 1.0;
    }
    sums.into_iter().filter(|(_, s)| s[1] >= 10.0).map(|(k, s)| (k, s[0] / s[1])).collect()
}

fn cut_found(context: &Context, on_select: f64) -> Found {
    let [estimate, hold_out] = [Role::Estimate, Role::HoldOut].map(|r| context.of(r));
    let cut = range_cut(context.frames, &estimate).unwrap_or(on_select);
    let beyond = |i: usize| context.frames[i].simulated.iter().filter(|r| f64::from(r.range_m) > cut).count() as f64;
    // Each return that a simulation without the cut has beyond it is a sure surprise: a factor of a hundred.
    let held = hold_out.iter().map(|&i| beyond(i) * 100f64.ln()).collect();
    let longest = 1.4 * cut;
    let points = (0..20).map(|b| {
        let [low, high] = [f64::from(b), f64::from(b + 1)].map(|v| v * longest / 20.0);
        let count = |side: fn(&FramePair) -> &Vec<Ray>| {
            let rays = estimate.iter().flat_map(|&i| side(&context.frames[i]));
            rays.filter(|r| (low..high).contains(&r.own_range_m())).count() as f64
        };
        let (a, b) = (count(|f| &f.measured), count(|f| &f.simulated));
        CurvePoint {
            x: 0.5 * (low + high),
            measured: a,
            before: b,
            after: if low >= cut { 0.0 } else { b },
            error: a.sqrt(),
        }
    });
    Found {
        status: Status::Named,
        causes: vec!["range_cut".into()],
        family: "detection",
        parameters: vec![parameter("max_m", cut, 0.004 * cut, "m")],
        confidence: 1.0,
        channel: "hits",
        covariate: "range_m".into(),
        held_out_gains: held,
        says: format!("nothing is measured beyond {cut:.1} m; your simulator has returns there"),
        separate_by: None,
        curve: Curve { x: "range, m".into(), y: "returns".into(), points: points.collect() },
    }
}

fn blocked_found(context: &Context, mask: &Mask) -> Found {
    let hold_out = context.of(Role::HoldOut);
    let inside = |r: &Ray| mask.blocked.contains(&direction_cell(r));
    // Returns that do not come, or that come from the own car where the simulation has nothing.
    let surprises = |i: usize| {
        let frame = &context.frames[i];
        let hidden = frame.simulated.iter().filter(|r| inside(r)).count();
        let near = frame.measured.iter().filter(|r| r.own_range_m() < OWN_CAR_M && inside(r)).count();
        hidden.max(near) as f64
    };
    let held: Vec<f64> = hold_out.iter().map(|&i| surprises(i) * 20f64.ln()).collect();
    // The sensor with the most blocked cells is described.
    let sensor = (0..context.rig.sensors.len() as u8)
        .max_by_key(|s| mask.blocked.iter().filter(|c| c.0 == *s).count())
        .unwrap_or(0);
    let cells: Vec<&DirectionCell> = mask.blocked.iter().filter(|c| c.0 == sensor).collect();
    let span = |f: fn(&DirectionCell) -> i32, step: f64| {
        let low = cells.iter().map(|c| f(c)).min().unwrap_or(0);
        let high = cells.iter().map(|c| f(c)).max().unwrap_or(0) + 1;
        [f64::from(low) * step, f64::from(high) * step].map(f64::to_degrees)
    };
    let (az, el) = (span(|c| c.1, AZIMUTH_RAD), span(|c| c.2, ELEVATION_RAD));
    let [az_step, el_step] = [AZIMUTH_RAD, ELEVATION_RAD].map(f64::to_degrees);
    let estimate = context.of(Role::Estimate);
    let all: f64 = context.returns(&estimate);
    let hidden = estimate.iter().flat_map(|&i| &context.frames[i].simulated).filter(|r| inside(r)).count() as f64;
    let counts = direction_counts(context.frames, &estimate);
    let points =
        counts.iter().filter(|(c, _)| c.0 == sensor && (el[0]..el[1]).contains(&((f64::from(c.2) + 0.5) * el_step)));
    let points = points.map(|(c, [n, seen, ..])| CurvePoint {
        x: (f64::from(c.1) + 0.5) * az_step,
        measured: seen / n.max(1.0),
        before: 1.0,
        after: if mask.blocked.contains(c) { 0.0 } else { 1.0 },
        error: 1.0 / n.max(1.0).sqrt(),
    });
    let edge = |name: &str, v: f64, step: f64| parameter(name, v, 0.6 * step, "deg");
    Found {
        status: Status::Named,
        causes: vec!["ego_occlusion".into()],
        family: "detection",
        parameters: vec![
            (
                "sensor".into(),
                Parameter { estimate: f64::from(sensor), unit: "number".into(), ci95: [f64::from(sensor); 2] },
            ),
            edge("azimuth_from_deg", az[0], az_step),
            edge("azimuth_to_deg", az[1], az_step),
            edge("elevation_from_deg", el[0], el_step),
            edge("elevation_to_deg", el[1], el_step),
            parameter("share", hidden / all.max(1.0), 0.1 * hidden / all.max(1.0), "1"),
        ],
        confidence: 1.0,
        channel: "hits",
        covariate: "direction".into(),
        held_out_gains: held,
        says: format!(
            "sensor {} sees nothing at azimuth {:.0} to {:.0} and elevation {:.0} to {:.0} degrees, in all frames: a part of the own car stands in the way",
            context.rig.sensors[sensor as usize].name, az[0], az[1], el[0], el[1]
        ),
        separate_by: None,
        curve: Curve {
            x: "azimuth, degrees".into(),
            y: "share of simulated returns that are measured".into(),
            points: points.collect(),
        },
    }
}
