//! What a table of the shares of matched returns predicts of other frames.

use super::table;
use crate::catalogue::Kind;
use crate::channels::cells::cell;
use crate::channels::hits::hit_frames;
use crate::channels::mask::{DirectionCell, Mask, direction_cell, on_ego_vehicle};
use crate::pairing::Ray;
use crate::search::Context;
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};

/// Returns of a cell of directions that count as the prior of its own share of losses.
const PRIOR_OF_DIRECTION: f64 = 30.0;

/// Gains of frames by tables of the shares of matched returns, nats, frame by frame.
pub struct Lost {
    /// By cell of range, incidence and surface.
    surfaces: Vec<f64>,
    /// What each cell of directions adds to that, with returns of the ego vehicle.
    directions: Vec<BTreeMap<DirectionCell, f64>>,
}

impl Lost {
    /// By kind.
    pub fn kinds(&self) -> BTreeMap<Kind, Vec<f64>> {
        let directions = self.directions.iter().map(|cells| cells.values().sum()).collect();
        BTreeMap::from([(Kind::Directions, directions), (Kind::Surfaces, self.surfaces.clone())])
    }

    /// Of some cells of directions.
    pub fn within(&self, place: &BTreeSet<DirectionCell>) -> Vec<f64> {
        self.directions.iter().map(|cells| place.iter().filter_map(|cell| cells.get(cell)).sum()).collect()
    }
}

/// Gains of the `test` frames by the shares of matched returns of the `train` frames.
pub fn by_table(context: &Context, train: &[usize], test: &[usize]) -> Lost {
    let hits = hit_frames(context.frames, &Mask::default());
    let unmatched = table(&hits, train).unmatched(&[]);
    // Returns whose incidence is not known, and those with a counterpart, of both sides by range.
    let mut at_edges = BTreeMap::<i32, [[f64; 2]; 2]>::new();
    let bin = |ray: &Ray| (f64::from(ray.range_m).max(0.5).ln() / 0.25) as i32;
    for frame in train.iter().map(|&i| &context.frames[i]) {
        for (side, rays) in frame.for_losses().into_iter().enumerate() {
            for ray in rays.into_iter().filter(|ray| cell(ray).is_none()) {
                let [n, matched] = &mut at_edges.entry(bin(ray)).or_default()[side];
                (*n, *matched) = (*n + 1.0, *matched + f64::from(u8::from(ray.matched)));
            }
        }
    }
    let usual = at_edges.values().fold([0.0; 2], |s, [_, [n, matched]]| [s[0] + n, s[1] + matched]);
    let usual = (usual[1] + 1.0) / (usual[0] + 1.0);
    let edge = |ray: &Ray| {
        let [simulated, measured] = at_edges.get(&bin(ray)).copied().unwrap_or_default();
        let share =
            |[n, matched]: [f64; 2], towards: f64| (matched + PRIOR_OF_DIRECTION * towards) / (n + PRIOR_OF_DIRECTION);
        let without = share(measured, usual);
        [share(simulated, without), without]
    };
    // Share of the returns like a ray that have a counterpart: in these data, and without losses.
    let expected = |ray: &Ray| cell(ray).map_or_else(|| edge(ray), |c| unmatched[c].map(|share| 1.0 - share));
    let of_directions = ratios_by_direction(context, train, &expected);
    let of_ray = |ray: &Ray| {
        let [kept, without] = expected(ray);
        let [of_simulated, of_measured] = of_directions.get(&direction_cell(ray)).copied().unwrap_or([1.0; 2]);
        let ln = |share: f64| {
            let share = share.clamp(1e-3, 1.0 - 1e-3);
            if ray.matched { share.ln() } else { (1.0 - share).ln() }
        };
        // Of surfaces what they change at the ratio of the measured side, of directions what the ratios change.
        let by_surface = ln(kept * of_measured);
        [by_surface - ln(without * of_measured), ln(kept * of_simulated) - by_surface]
    };
    let on_vehicle = of_ego_vehicle(context, train);
    let of_frame = |&i: &usize| {
        let (mut by_surface, mut directions) = (0.0, on_vehicle(i));
        for ray in &context.frames[i].simulated {
            let [surface, direction] = of_ray(ray);
            by_surface += surface;
            *directions.entry(direction_cell(ray)).or_default() += direction;
        }
        (by_surface, directions)
    };
    let (surfaces, directions) = test.par_iter().map(of_frame).unzip();
    Lost { surfaces, directions }
}

/// A cell of directions.
#[derive(Clone, Copy, Debug, Default)]
struct OfDirection {
    /// Simulated returns.
    returns: f64,
    /// Returns without a counterpart of the simulated and of the measured side, and how many are expected of surfaces
    /// like theirs.
    alone: [f64; 2],
    expected: [f64; 2],
}

impl OfDirection {
    /// Ratio of the returns with a counterpart to those that are expected to have one, where so many have none.
    fn ratio(&self, alone: f64, expected: f64) -> f64 {
        let with = |none: f64| (self.returns - none).max(0.0) + PRIOR_OF_DIRECTION;
        with(alone) / with(expected)
    }

    /// Ratios of the two sides if surfaces tell all, if both sides lose alike by direction, and if they lose apart.
    fn ratios(&self) -> [[f64; 2]; 3] {
        let of_side = |side: usize| self.ratio(self.alone[side], self.expected[side]);
        let of_both = self.ratio(self.alone.iter().sum::<f64>() / 2.0, self.expected.iter().sum::<f64>() / 2.0);
        [[1.0; 2], [of_both; 2], [of_side(0), of_side(1)]]
    }

    /// Logarithms of the probabilities of these numbers in the three cases. Each ratio that is fitted costs half the
    /// logarithm of the returns of both sides (BIC).
    fn evidence(&self) -> [f64; 3] {
        let all = self.returns.max(1.0);
        let likelihood = |side: usize, ratio: f64| {
            let share = (ratio * (1.0 - self.expected[side] / all)).clamp(1e-3, 1.0 - 1e-3);
            let alone = self.alone[side].min(all);
            (all - alone) * share.ln() + alone * (1.0 - share).ln()
        };
        let of_case = |[simulated, measured]: [f64; 2]| likelihood(0, simulated) + likelihood(1, measured);
        let [none, alike, apart] = self.ratios().map(of_case);
        let cost = 0.5 * (2.0 * all).ln();
        [none, alike - cost, apart - 2.0 * cost]
    }
}

/// Rounds in which the shares of the cases are found.
const ROUNDS: usize = 10;

/// Ratio of the returns with a counterpart to those that are expected to have one in each cell of directions, of the
/// simulated and of the measured side. Both are low where both sides lose returns.
///
/// Ratios that chance alone makes predict nothing of other frames. They are averaged over the cases that surfaces tell
/// all, that both sides lose alike and that they lose apart, with the probabilities of these by the numbers of the
/// cell; the priors are the shares of the cases among all cells, by expectation maximisation.
fn ratios_by_direction(
    context: &Context,
    train: &[usize],
    expected: &dyn Fn(&Ray) -> [f64; 2],
) -> BTreeMap<DirectionCell, [f64; 2]> {
    let mut cells = BTreeMap::<DirectionCell, OfDirection>::new();
    for frame in train.iter().map(|&i| &context.frames[i]) {
        for (side, rays) in frame.for_losses().into_iter().enumerate() {
            // What only the measured ego vehicle hides is lost.
            let hides = |ray: &Ray| side == 1 && !ray.matched && on_ego_vehicle(ray);
            for ray in rays.into_iter().filter(|ray| !hides(ray)) {
                let cell = cells.entry(direction_cell(ray)).or_default();
                cell.returns += [1.0, 0.0][side];
                cell.alone[side] += f64::from(u8::from(!ray.matched));
                cell.expected[side] += 1.0 - expected(ray)[side];
            }
        }
    }
    let evidences: Vec<[f64; 3]> = cells.values().map(OfDirection::evidence).collect();
    let probabilities = |evidence: &[f64; 3], shares: &[f64; 3]| {
        let most = evidence.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let weights = [0, 1, 2].map(|case| shares[case] * (evidence[case] - most).exp());
        weights.map(|weight| weight / weights.iter().sum::<f64>())
    };
    let round = |shares: [f64; 3], _| {
        let sums = evidences.iter().map(|evidence| probabilities(evidence, &shares));
        let sums = sums.fold([1.0; 3], |[a, b, c], [x, y, z]| [a + x, b + y, c + z]);
        sums.map(|sum| sum / sums.iter().sum::<f64>())
    };
    let shares = (0..ROUNDS).fold([1.0 / 3.0; 3], round);
    let averaged = |((at, cell), evidence): ((DirectionCell, OfDirection), &[f64; 3])| {
        let cases = probabilities(evidence, &shares).into_iter().zip(cell.ratios());
        (at, cases.fold([0.0; 2], |[a, b], (p, [simulated, measured])| [a + p * simulated, b + p * measured]))
    };
    cells.into_iter().zip(&evidences).map(averaged).collect()
}

/// Gains of the `test` frames by the shares of matched returns of the `train` frames, by cell of range, incidence and
/// surface alone, nats.
pub fn by_cell(context: &Context, train: &[usize], test: &[usize]) -> Vec<f64> {
    let hits = hit_frames(context.frames, &Mask::default());
    let table = table(&hits, train);
    let shares = table.matched_shares(&[]);
    test.iter().map(|&i| table.gain_by_table(&hits[i], &shares)).collect()
}

/// Gains of a frame in each cell of directions by the numbers of returns of the ego vehicle of the `train` frames,
/// nats. Returns that lie on a simulated surface, which may be its own, are none.
fn of_ego_vehicle<'a>(
    context: &'a Context,
    train: &[usize],
) -> impl Fn(usize) -> BTreeMap<DirectionCell, f64> + Sync + use<'a> {
    let count = |rays: &[Ray]| {
        let mut counts = BTreeMap::<DirectionCell, f64>::new();
        for ray in rays.iter().filter(|ray| on_ego_vehicle(ray)) {
            *counts.entry(direction_cell(ray)).or_default() += 1.0;
        }
        counts
    };
    // Near returns of a frame in each cell: measured and simulated.
    let mut rates = BTreeMap::<DirectionCell, [f64; 2]>::new();
    for frame in train.iter().map(|&i| &context.frames[i]) {
        for (side, rays) in [&frame.measured, &frame.simulated].into_iter().enumerate() {
            count(rays).into_iter().for_each(|(cell, n)| rates.entry(cell).or_default()[side] += n);
        }
    }
    let frames = train.len() as f64;
    rates.values_mut().for_each(|rates| *rates = rates.map(|n| (n + 0.5) / (frames + 1.0)));
    move |frame| {
        let counts = count(&context.frames[frame].measured);
        let of_cell = |(cell, [measured, simulated]): (&DirectionCell, &[f64; 2])| {
            let n = counts.get(cell).copied().unwrap_or(0.0);
            (*cell, n * (measured / simulated).ln() - (measured - simulated))
        };
        rates.iter().map(of_cell).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::inference::roles::roles;
    use crate::pairing::FramePair;
    use nalgebra::Vector3;
    use rand::RngExt;
    use sensor::Rig;

    /// Gains by direction and by surface of frames of walls, each at another distance. Each side keeps a return with a
    /// probability by its tangents beside and above the middle.
    fn gains([simulated, measured]: [&dyn Fn(f64, f64) -> f64; 2]) -> [f64; 2] {
        let mut rng = data::stream(1, "losses", 0, 0);
        let frame = |id: usize| {
            let mut sides = [vec![], vec![]];
            let depth = 8.0 + 2.0 * (id % 15) as f64;
            for (y, z) in (-40..40).flat_map(|y| (-8..8).map(move |z| (0.02 * f64::from(y), 0.02 * f64::from(z)))) {
                let ray = Ray::standing(&(depth * Vector3::new(1.0, y, z)));
                let kept = [simulated, measured].map(|keep| rng.random_bool(keep(y, z)));
                let returns = sides.iter_mut().zip(kept).filter(|(_, kept)| *kept);
                returns.for_each(|(side, _)| side.push(Ray { matched: kept[0] && kept[1], ..ray }));
            }
            let [simulated, measured] = sides;
            FramePair::of_rays(id.to_string(), measured, simulated)
        };
        let frames: Vec<FramePair> = (0..60).map(frame).collect();
        let rig = Rig::single();
        let context =
            Context { rig: &rig, frames: &frames, roles: roles(60), times: None, motion: None, to_next: vec![] };
        let [train, test] = [0, 30].map(|from| (from..from + 30).collect::<Vec<usize>>());
        let of_kind = by_table(&context, &train, &test).kinds();
        [Kind::Directions, Kind::Surfaces].map(|kind| of_kind[&kind].iter().sum())
    }

    #[test]
    fn losses_in_a_patch_are_of_directions_and_losses_everywhere_of_surfaces() {
        let (all, most) = (|_: f64, _: f64| 0.95, |_: f64, _: f64| 0.75);
        let patch = |y: f64, z: f64| if (y - 0.4).hypot(z) < 0.1 { 0.5 } else { 0.95 };
        let [directions, surfaces] = gains([&all, &patch]);
        assert!(directions > 3.0 * surfaces.abs() && surfaces > 0.0, "{directions} {surfaces}");
        let [directions, surfaces] = gains([&all, &most]);
        assert!(surfaces > 500.0 && directions.abs() < 0.02 * surfaces, "{directions} {surfaces}");
        // Both sides lose alike: half a nat is left for each cell of surfaces.
        for both in [&all as &dyn Fn(f64, f64) -> f64, &most, &patch] {
            let [directions, surfaces] = gains([both, both]);
            assert!(directions.abs() < 5.0 && surfaces.abs() < 50.0, "{directions} {surfaces}");
        }
    }
}
