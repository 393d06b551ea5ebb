//! What hides rays altogether: the largest range, parts of the ego vehicle, patches of directions. Searched before
//! laws of losses.

use super::hits::refit;
use super::{ChannelResult, Context, Found, NamedParameter, parameter, patch, sensor_number};
use crate::catalogue::{Cause, Channel, Covariate, Quantity};
use crate::channels::cells::cell;
use crate::channels::hits::{hit_frames, total};
use crate::channels::mask::{
    AZIMUTH_RAD, DirectionCell, ELEVATION_RAD, Mask, Shown, below, blocked_cells, cells_within, direction_cell,
    direction_counts, edge_cells, with_neighbours,
};
use crate::channels::range_ends::{End, RangeEnd, half_point, near_cut, range_cut};
use crate::channels::returns::OWN_CAR_M;
use crate::curve::{Curve, CurvePoint};
use crate::diagnosis::{Considered, Minimum, Status};
use crate::effects::rounded;
use crate::inference::law::Law;
use crate::inference::losses::LossTable;
use crate::inference::roles::Role;
use crate::pairing::{FramePair, Ray};
use sensor::effects::{Effect, EgoBodyMask};
use std::collections::{BTreeMap, BTreeSet};

/// Smallest azimuth range of a part of the ego vehicle that would be detected, cells.
const LEAST_CELLS: f64 = 2.0;

/// Factor by which a return beyond the largest range is less likely with the cut than without it.
const CUT_SURPRISE: f64 = 100.0;

/// Factor by which a return in a hidden direction, or one from the ego vehicle, is less likely without the occlusion.
const OCCLUSION_SURPRISE: f64 = 20.0;

/// The search, and the mask of what the other searches leave out.
pub fn search(context: &Context, shown: Shown) -> (ChannelResult, Mask) {
    let (mask, spots) = find(context, shown);
    let mut result = ChannelResult::new(Channel::Hits, context.of(Role::HoldOut).len());
    result.found.extend(mask.cut.map(|cut| cut_found(context, End::Far, cut)));
    result.found.extend(mask.near.map(|near| cut_found(context, End::Near, near)));
    if !mask.blocked.is_empty() {
        result.found.push(blocked_found(context, &mask));
    }
    let patched = !spots.is_empty();
    result.found.extend(spots);
    let searched = [
        (Cause::RangeCut, mask.cut.is_some()),
        (Cause::NearCut, mask.near.is_some()),
        (Cause::EgoOcclusion, !mask.blocked.is_empty()),
        (Cause::DirtyWindow, patched),
    ];
    result.considered.extend(searched.map(|(cause, found)| Considered {
        cause: cause.into(),
        channel: Channel::Hits,
        nats_per_ray: 0.0,
        z: 0.0,
        outcome: if found { "chosen" } else { "no such place" }.into(),
    }));
    let minimum = Minimum::new(Quantity::AzimuthWidthDeg, LEAST_CELLS * AZIMUTH_RAD.to_degrees());
    result.minimum.push((Cause::EgoOcclusion, minimum));
    for found in &result.found {
        result.distance.iter_mut().zip(&found.held_out_gains).for_each(|(d, g)| (0..3).for_each(|k| d[k] += g));
    }
    (result, mask)
}

/// Gains of the `test` frames by a largest range of the `train` frames, nats: all measured returns lie before it, not
/// all simulated ones.
pub fn cut_by_table(context: &Context, train: &[usize], test: &[usize]) -> Vec<f64> {
    let Some(cut) = range_cut(context.frames, train) else { return vec![0.0; test.len()] };
    let rays = || train.iter().flat_map(|&i| &context.frames[i].simulated);
    let beyond = rays().filter(|r| r.own_range_m() > cut.at_m).count() as f64 / rays().count().max(1) as f64;
    test.iter().map(|&i| -(1.0 - beyond).ln() * context.frames[i].measured.len() as f64).collect()
}

/// The mask on the selecting frames, and findings of patches of directions.
fn find(context: &Context, shown: Shown) -> (Mask, Vec<Found>) {
    let select = context.of(Role::Select);
    // Another street may have nothing near.
    let near = (shown != Shown::Another).then(|| near_cut(context.frames, &select)).flatten();
    let mut mask = Mask { cut: range_cut(context.frames, &select), near, ..Mask::default() };
    let counts = direction_counts(context.frames, &select);
    // Losses that laws explain are no occlusion, whether the laws are fitted with the dark directions or without
    // them. Far ground may be dark in all directions.
    let dark = blocked_cells(&counts, shown, &|_| 1.0);
    let mut fits = vec![expected_shares(context, &select, &mask, &mask)];
    if !dark.is_empty() {
        let without = Mask { around: with_neighbours(&dark), blocked: dark, ..mask.clone() };
        fits.push(expected_shares(context, &select, &mask, &without));
    }
    let expected = |cell: &DirectionCell| {
        let of_fit = |fit: &BTreeMap<DirectionCell, f64>| fit.get(cell).copied().unwrap_or(0.0);
        fits.iter().map(of_fit).fold(f64::INFINITY, f64::min)
    };
    mask.blocked = blocked_cells(&counts, shown, &expected);
    let edge = edge_cells(&mask.blocked, &counts, &expected);
    let hidden: BTreeSet<DirectionCell> = mask.blocked.union(&edge).copied().collect();
    mask.around = with_neighbours(&hidden.union(&below(&hidden, &counts)).copied().collect());
    mask.partly = edge;
    let spots = if shown != Shown::Another { patch::search(context, &mut mask) } else { vec![] };
    (mask, spots)
}

/// Rays that tell what laws keep in a cell of directions.
const ENOUGH: f64 = 10.0;

/// How many cells around may tell it as well.
const AROUND_CELLS: i32 = 3;

/// Share of the returns that laws keep in each cell of directions. The laws are fitted on the rays that
/// `fitted_without` does not hide.
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
        let sum = sums.entry(direction_cell(ray)).or_default();
        let kept = match cell(ray) {
            _ if mask.hides(ray) => 0.0,
            Some(c) => table.kept(&laws, c),
            // The incidence of edges is not known; the rays around them decide.
            None => continue,
        };
        sum[0] += kept;
        sum[1] += 1.0;
    }
    // Where too few rays tell, those of the cells around count as well.
    let within = |cell: DirectionCell, cells: i32| {
        let known = cells_within(cell, cells).filter_map(|cell| sums.get(&cell));
        known.fold([0.0; 2], |sum, own| [sum[0] + own[0], sum[1] + own[1]])
    };
    let share = |cell: &DirectionCell| {
        let [kept, all] = (0..=AROUND_CELLS).map(|cells| within(*cell, cells)).find(|[_, all]| *all >= ENOUGH)?;
        Some((*cell, kept / all))
    };
    sums.keys().filter_map(share).collect()
}

/// Whether a range lies outside of what is measured.
fn excludes(end: End, range_m: f64, cut_m: f64) -> bool {
    match end {
        End::Near => range_m < cut_m,
        End::Far => range_m > cut_m,
    }
}

/// The finding of a smallest or largest range.
fn cut_found(context: &Context, end: End, on_select: RangeEnd) -> Found {
    let [estimate, hold_out] = [Role::Estimate, Role::HoldOut].map(|r| context.of(r));
    let (found, cause, quantity) = match end {
        End::Near => (near_cut(context.frames, &estimate), Cause::NearCut, Quantity::MinM),
        End::Far => (range_cut(context.frames, &estimate), Cause::RangeCut, Quantity::MaxM),
    };
    let about = found.unwrap_or(on_select).at_m;
    let [cut, error] = half_point(context.frames, &estimate, &context.blocks(&estimate), about, end);
    let outside = |ray: &&Ray| excludes(end, f64::from(ray.range_m), cut);
    let beyond = |i: usize| context.frames[i].simulated.iter().filter(outside).count() as f64;
    let held = hold_out.iter().map(|&i| beyond(i) * CUT_SURPRISE.ln()).collect();
    let longest = 1.4 * cut;
    let points = (0..20).map(|b| {
        let [low, high] = [f64::from(b), f64::from(b + 1)].map(|v| v * longest / 20.0);
        let count = |side: fn(&FramePair) -> &Vec<Ray>| {
            let rays = estimate.iter().flat_map(|&i| side(&context.frames[i]));
            rays.filter(|r| (low..high).contains(&r.own_range_m())).count() as f64
        };
        let (a, b) = (count(|f| &f.measured), count(|f| &f.simulated));
        let middle = 0.5 * (low + high);
        let after = if excludes(end, middle, cut) { 0.0 } else { b };
        CurvePoint { sensor: 0, x: middle, measured: a, before: b, after, error: a.sqrt() }
    });
    let than = if end == End::Near { "nearer than" } else { "beyond" };
    Found {
        effects: Vec::new(),
        status: Status::Named,
        causes: vec![cause],
        parameters: vec![parameter(quantity, cut, error)],
        confidence: 1.0,
        channel: Channel::Hits,
        covariate: Covariate::Range,
        held_out_gains: held,
        says: format!("nothing is measured {than} {cut:.1} m; your simulator has returns there"),
        separate_by: None,
        curve: Curve { x: "range, m".into(), y: "returns".into(), by_sensor: false, points: points.collect() },
    }
}

/// Hidden directions of one sensor.
struct Occlusion {
    sensor: u8,
    /// Azimuth and elevation, from and to, degrees.
    azimuth: [f64; 2],
    elevation: [f64; 2],
}

impl Occlusion {
    /// That of the sensor with the most hidden cells.
    fn of(mask: &Mask, sensors: usize) -> Self {
        let sensor = (0..sensors as u8).max_by_key(|s| mask.blocked.iter().filter(|c| c.0 == *s).count()).unwrap_or(0);
        let cells: Vec<&DirectionCell> = mask.blocked.iter().filter(|c| c.0 == sensor).collect();
        let span = |f: fn(&DirectionCell) -> i32, step: f64| {
            let low = cells.iter().map(|c| f(c)).min().unwrap_or(0);
            let high = cells.iter().map(|c| f(c)).max().unwrap_or(0) + 1;
            [f64::from(low) * step, f64::from(high) * step].map(f64::to_degrees)
        };
        Occlusion { sensor, azimuth: span(|c| c.1, AZIMUTH_RAD), elevation: span(|c| c.2, ELEVATION_RAD) }
    }

    /// Ends of the hidden directions, known within 0.6 of a cell, and the share of all returns that is in them.
    fn parameters(&self, hidden: f64, all: f64) -> Vec<NamedParameter> {
        let [az_step, el_step] = [AZIMUTH_RAD, ELEVATION_RAD].map(f64::to_degrees);
        let edge = |quantity, v: f64, step: f64| parameter(quantity, v, 0.6 * step);
        vec![
            sensor_number(usize::from(self.sensor)),
            edge(Quantity::AzimuthFromDeg, self.azimuth[0], az_step),
            edge(Quantity::AzimuthToDeg, self.azimuth[1], az_step),
            edge(Quantity::ElevationFromDeg, self.elevation[0], el_step),
            edge(Quantity::ElevationToDeg, self.elevation[1], el_step),
            parameter(Quantity::Share, hidden / all, 0.1 * hidden / all),
        ]
    }

    /// Share of the simulated returns that are measured along the azimuth, over the hidden elevations.
    fn curve(&self, context: &Context, frames: &[usize], mask: &Mask) -> Curve {
        let [az_step, el_step] = [AZIMUTH_RAD, ELEVATION_RAD].map(f64::to_degrees);
        let counts = direction_counts(context.frames, frames);
        let level =
            |c: &DirectionCell| (self.elevation[0]..self.elevation[1]).contains(&((f64::from(c.2) + 0.5) * el_step));
        // Simulated returns of each azimuth, those that are measured and those that are not hidden.
        let mut columns = BTreeMap::<i32, [f64; 3]>::new();
        for (cell, [n, seen, ..]) in counts.iter().filter(|(c, _)| c.0 == self.sensor && level(c)) {
            let sum = columns.entry(cell.1).or_default();
            let open = f64::from(u8::from(!mask.blocked.contains(cell)));
            *sum = [sum[0] + n, sum[1] + seen, sum[2] + n * open];
        }
        let points = columns.into_iter().filter(|(_, [n, ..])| *n > 0.0).map(|(azimuth, [n, seen, open])| CurvePoint {
            sensor: 0,
            x: (f64::from(azimuth) + 0.5) * az_step,
            measured: (seen / n).min(1.0),
            before: 1.0,
            after: open / n,
            error: 1.0 / n.sqrt(),
        });
        Curve {
            x: "azimuth, degrees".into(),
            y: "share of simulated returns that are measured".into(),
            by_sensor: false,
            points: points.collect(),
        }
    }
}

/// Neighbouring cells of one elevation that are hidden alike.
struct Run {
    first: DirectionCell,
    /// The azimuth after the last cell.
    end: i32,
    /// Share of the returns that is lost.
    lost: f64,
    /// The part's own returns; none where most shots have none.
    shown: Vec<PartReturn>,
}

/// Own range, m, and intensity of a return from a part of the ego vehicle.
type PartReturn = [f64; 2];

/// Distance of the returns of two cells from which on they are of different parts, m: several times the noise of a
/// range.
const OTHER_PART_M: f64 = 0.05;

impl Run {
    /// Mean and standard deviation of the own ranges, m, or of the intensities.
    fn moments(&self, of: usize) -> [f64; 2] {
        let values: Vec<f64> = self.shown.iter().map(|r| r[of]).collect();
        [statistics::mean(&values), statistics::deviation(&values)]
            .map(|v| if v.is_finite() { rounded(v, 4) } else { 0.0 })
    }

    /// Whether a cell's returns continue those of the run.
    fn joins(&self, next: DirectionCell, lost: f64, shown: &[PartReturn]) -> bool {
        let median = |returns: &[PartReturn]| statistics::median_upper(returns.iter().map(|r| r[0]).collect());
        let alike = match (median(&self.shown), median(shown)) {
            (Some(a), Some(b)) => (a - b).abs() < OTHER_PART_M,
            (None, None) => true,
            _ => false,
        };
        self.first.2 == next.2 && self.end == next.1 && self.lost == lost && alike
    }
}

/// The hidden directions of every sensor with the share of their returns that is lost: neighbouring cells of one
/// elevation that lose alike are one entry.
fn hidden_directions(context: &Context, frames: &[usize], mask: &Mask) -> Vec<Effect> {
    let counts = direction_counts(context.frames, frames);
    let lost = |cell: &DirectionCell| {
        let [n, seen, ..] = counts.get(cell).copied().unwrap_or_default();
        (((1.0 - seen / n.max(1.0)).clamp(0.0, 1.0)) * 20.0).round() / 20.0
    };
    // Near returns of the part itself, in place of those that it hides.
    let mut near = BTreeMap::<DirectionCell, Vec<PartReturn>>::new();
    for ray in frames.iter().flat_map(|&i| &context.frames[i].measured) {
        if ray.own_range_m() < OWN_CAR_M && mask.blocked.contains(&direction_cell(ray)) {
            near.entry(direction_cell(ray)).or_default().push([ray.own_range_m(), f64::from(ray.intensity)]);
        }
    }
    near.retain(|cell, shown| 2.0 * shown.len() as f64 > counts.get(cell).map_or(0.0, |c| c[0]));
    let mut of_sensors: BTreeMap<u8, Vec<Run>> = BTreeMap::new();
    // In the order of sensor, elevation and azimuth, so that neighbours follow each other.
    let mut cells: Vec<(DirectionCell, f64)> = mask.blocked.iter().map(|c| (*c, lost(c).max(0.9))).collect();
    cells.extend(mask.partly.difference(&mask.blocked).map(|c| (*c, lost(c))).filter(|(_, lost)| *lost > 0.0));
    cells.sort_by_key(|((sensor, azimuth, elevation), _)| (*sensor, *elevation, *azimuth));
    for (first, lost) in cells {
        let (runs, shown) = (of_sensors.entry(first.0).or_default(), near.remove(&first).unwrap_or_default());
        match runs.last_mut().filter(|run| run.joins(first, lost, &shown)) {
            Some(run) => {
                run.end += 1;
                run.shown.extend(shown);
            }
            None => runs.push(Run { first, end: first.1 + 1, lost, shown }),
        }
    }
    let degrees = |k: i32, step: f64| rounded((f64::from(k) * step).to_degrees(), 4);
    let effect = |(sensor, runs): (u8, Vec<Run>)| {
        let direction = |run: &Run| {
            let (_, azimuth, elevation) = run.first;
            let [from, to] = [azimuth, run.end].map(|k| degrees(k, AZIMUTH_RAD));
            let [low, high] = [elevation, elevation + 1].map(|k| degrees(k, ELEVATION_RAD));
            [from, to, low, high, run.lost]
        };
        let returns = |of: usize| match runs.iter().any(|run| !run.shown.is_empty()) {
            true => runs.iter().map(|run| run.moments(of)).collect(),
            false => Vec::new(),
        };
        let ranges = returns(0);
        let has_intensity = runs.iter().flat_map(|run| &run.shown).all(|r| r[1].is_finite());
        Effect::EgoBodyMask(EgoBodyMask {
            sensor: context.rig.sensors[usize::from(sensor)].name.clone(),
            boxes: vec![],
            directions: runs.iter().map(direction).collect(),
            returns_m: ranges.iter().map(|moments| moments[0]).collect(),
            returns_std_m: ranges.iter().map(|moments| moments[1]).collect(),
            returns_intensity: if has_intensity { returns(1) } else { vec![] },
        })
    };
    of_sensors.into_iter().map(effect).collect()
}

/// The finding of a part of the ego vehicle in the field of view. The sensor with the most hidden cells is described.
fn blocked_found(context: &Context, mask: &Mask) -> Found {
    let [estimate, hold_out] = [Role::Estimate, Role::HoldOut].map(|r| context.of(r));
    let inside = |r: &Ray| mask.blocked.contains(&direction_cell(r));
    // Lost returns, or returns from the ego vehicle where the simulation has none.
    let surprises = |i: usize| {
        let frame = &context.frames[i];
        let hidden = frame.simulated.iter().filter(|r| inside(r)).count();
        let near = frame.measured.iter().filter(|r| r.own_range_m() < OWN_CAR_M && inside(r)).count();
        hidden.max(near) as f64
    };
    let held: Vec<f64> = hold_out.iter().map(|&i| surprises(i) * OCCLUSION_SURPRISE.ln()).collect();
    let occlusion = Occlusion::of(mask, context.rig.sensors.len());
    let all = context.returns(&estimate).max(1.0);
    let hidden = estimate.iter().flat_map(|&i| &context.frames[i].simulated).filter(|r| inside(r)).count() as f64;
    let (az, el) = (occlusion.azimuth, occlusion.elevation);
    Found {
        effects: hidden_directions(context, &estimate, mask),
        status: Status::Named,
        causes: vec![Cause::EgoOcclusion],
        parameters: occlusion.parameters(hidden, all),
        confidence: 1.0,
        channel: Channel::Hits,
        covariate: Covariate::Direction,
        held_out_gains: held,
        says: format!(
            "sensor {} sees nothing at azimuth {:.0} to {:.0} and elevation {:.0} to {:.0} degrees, in all frames: a part of the ego vehicle blocks the view",
            context.rig.sensors[usize::from(occlusion.sensor)].name,
            az[0],
            az[1],
            el[0],
            el[1]
        ),
        separate_by: None,
        curve: occlusion.curve(context, &estimate, mask),
    }
}
