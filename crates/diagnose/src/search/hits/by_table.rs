//! What a table of the shares of matched returns predicts of other frames.

use super::table;
use crate::channels::cells::cell;
use crate::channels::hits::hit_frames;
use crate::channels::mask::{DirectionCell, Mask, direction_cell};
use crate::channels::returns::OWN_CAR_M;
use crate::pairing::Ray;
use crate::search::Context;
use std::collections::BTreeMap;

/// Simulated returns of a cell of directions that count as the prior of its own share of losses.
const PRIOR_OF_DIRECTION: f64 = 30.0;

/// Gains of the `test` frames by the shares of matched returns of the `train` frames, nats: by cell of range,
/// incidence and surface, times those by cell of directions.
pub fn by_table(context: &Context, train: &[usize], test: &[usize]) -> Vec<f64> {
    let hits = hit_frames(context.frames, &Mask::default());
    let unmatched = table(&hits, train).unmatched(&[]);
    // Returns whose incidence is not known, and those with a counterpart, of both sides by range.
    let mut at_edges = BTreeMap::<i32, [[f64; 2]; 2]>::new();
    let bin = |ray: &Ray| (f64::from(ray.range_m).max(0.5).ln() / 0.25) as i32;
    for frame in train.iter().map(|&i| &context.frames[i]) {
        for (side, rays) in [&frame.simulated, &frame.measured].into_iter().enumerate() {
            for ray in rays.iter().filter(|ray| cell(ray).is_none()) {
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
    let mut of_directions = BTreeMap::<DirectionCell, [f64; 2]>::new();
    for ray in train.iter().flat_map(|&i| &context.frames[i].simulated) {
        let sums = of_directions.entry(direction_cell(ray)).or_default();
        sums[0] += f64::from(u8::from(ray.matched));
        sums[1] += expected(ray)[0];
    }
    let ratio = |ray: &Ray| {
        let [matched, kept] = of_directions.get(&direction_cell(ray)).copied().unwrap_or_default();
        (matched + PRIOR_OF_DIRECTION) / (kept + PRIOR_OF_DIRECTION)
    };
    let of_ray = |ray: &Ray| {
        let [kept, without] = expected(ray);
        let [p, q] = [without, kept * ratio(ray)].map(|share| share.clamp(1e-3, 1.0 - 1e-3));
        if ray.matched { (q / p).ln() } else { ((1.0 - q) / (1.0 - p)).ln() }
    };
    let of_frame = |&i: &usize| context.frames[i].simulated.iter().map(of_ray).sum::<f64>();
    test.iter().map(of_frame).zip(of_near_returns(context, train, test)).map(|(a, b)| a + b).collect()
}

/// Gains of the `test` frames by the shares of matched returns of the `train` frames, by cell of range, incidence and
/// surface alone, nats.
pub fn by_cell(context: &Context, train: &[usize], test: &[usize]) -> Vec<f64> {
    let hits = hit_frames(context.frames, &Mask::default());
    let table = table(&hits, train);
    let shares = table.matched_shares(&[]);
    test.iter().map(|&i| table.gain_by_table(&hits[i], &shares)).collect()
}

/// Gains of the `test` frames by the numbers of near returns of the `train` frames in each cell of directions, nats:
/// returns of the ego vehicle in place of those behind it.
fn of_near_returns(context: &Context, train: &[usize], test: &[usize]) -> Vec<f64> {
    let count = |rays: &[Ray]| {
        let mut counts = BTreeMap::<DirectionCell, f64>::new();
        for ray in rays.iter().filter(|ray| ray.own_range_m() < OWN_CAR_M) {
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
    let of_frame = |i: &usize| {
        let counts = count(&context.frames[*i].measured);
        let of_cell = |(cell, [measured, simulated]): (&DirectionCell, &[f64; 2])| {
            counts.get(cell).copied().unwrap_or(0.0) * (measured / simulated).ln() - (measured - simulated)
        };
        rates.iter().map(of_cell).sum::<f64>()
    };
    test.iter().map(of_frame).collect()
}
