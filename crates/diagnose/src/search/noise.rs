//! Noise: the roughness of measured returns beyond that of simulated ones, and on what it depends.

mod curve;
mod describe;
mod directions;
mod edges;
mod mixture;
mod select;
mod surfaces;
mod tails;

pub use self::surfaces::SurfaceShare;

use self::describe::found;
use self::edges::consider_both;
use self::select::Selection;
use super::{ChannelResult, Context, Z_STAR, first_demands};
use crate::catalogue::sizes::{JITTER_RAD, NOISE_M, NOISE_SHARE};
use crate::catalogue::{Cause, Channel, Quantity};
use crate::channels::roughness::{RoughFrame, rough_frames, scales, total};
use crate::diagnosis::Minimum;
use crate::inference::choice::Demands;
use crate::inference::linear::{LinearFit, LinearFrame, fit};
use crate::inference::noise::{NOISE_LAWS, NoiseLaw, NoiseTable};
use crate::inference::roles::Role;

/// Place of [`NoiseLaw::Constant`] in the list of laws.
const CONSTANT: usize = 0;

/// Place of [`NoiseLaw::Angular`] in the list of laws.
const ANGULAR: usize = 1;

/// A law with its coefficient, m2 or rad2.
type Term = (NoiseLaw, f64);

/// The search; surfaces with a cosine of incidence below `least_cos` are left out.
pub fn search(context: &Context, least_cos: f64) -> ChannelResult {
    let scales = scales(context.frames);
    let mut rough = rough_frames(context.frames, &scales);
    let mut result = ChannelResult::new(Channel::Roughness, context.of(Role::HoldOut).len());
    let drawn_m2 = tails::search(context, &mut rough, &scales, &mut result);
    Search { drawn_m2, ..Search::new(context, least_cos, scales, rough) }.run(&mut result);
    result
}

/// The search on all surfaces of different streets, and what of the found noise is measured on the ground and on
/// standing surfaces.
pub fn search_by_surface(context: &Context) -> (ChannelResult, [Option<SurfaceShare>; 2]) {
    let scales = scales(context.frames);
    let rough = rough_frames(context.frames, &scales);
    let mut result = ChannelResult::new(Channel::Roughness, context.of(Role::HoldOut).len());
    let search = Search { same_edges: false, ..Search::new(context, 0.0, scales, rough) };
    let laws = search.run(&mut result);
    (result, search.by_surface(&laws))
}

/// Gains of the `test` frames by variances of each cell and of each row fitted on the `train` frames, nats.
pub fn by_table(context: &Context, train: &[usize], test: &[usize]) -> Vec<f64> {
    let scales = scales(context.frames);
    let rough = rough_frames(context.frames, &scales);
    let table = |frames: &[usize]| NoiseTable::for_distances(total(frames.iter().map(|&i| &rough[i])));
    let (on_train, on_test) = (table(train), table(test));
    let gain = |i: &usize| on_test.likelihood_by_table(&rough[*i], &on_train) - on_test.likelihood(&rough[*i], &[]);
    test.iter().map(gain).collect()
}

/// Roughness of all frames, and the frames by role.
struct Search<'a> {
    context: &'a Context<'a>,
    least_cos: f64,
    /// Whether both sides show the same edges.
    same_edges: bool,
    /// Variance by which heavy tails draw the surfaces through their neighbours, m2: less is no other noise.
    drawn_m2: f64,
    scales: Vec<f64>,
    rough: Vec<RoughFrame>,
    select: Vec<usize>,
    estimate: Vec<usize>,
    hold_out: Vec<usize>,
    /// Blocks of the selecting frames.
    blocks: Vec<usize>,
    /// Variances over the selecting frames.
    table: NoiseTable,
    /// Sums of the selecting frames over all laws.
    linear: Vec<LinearFrame>,
    demands: Demands,
}

impl<'a> Search<'a> {
    fn new(context: &'a Context<'a>, least_cos: f64, scales: Vec<f64>, rough: Vec<RoughFrame>) -> Self {
        let [select, estimate, hold_out] = [Role::Select, Role::Estimate, Role::HoldOut].map(|r| context.of(r));
        let table = NoiseTable::new(total(select.iter().map(|&i| &rough[i])), least_cos);
        let linear = select.iter().map(|&i| table.linear(&rough[i], &NOISE_LAWS)).collect();
        let blocks = context.blocks(&select);
        let demands = first_demands();
        Search {
            context,
            least_cos,
            same_edges: true,
            drawn_m2: 0.0,
            scales,
            rough,
            select,
            estimate,
            hold_out,
            blocks,
            table,
            linear,
            demands,
        }
    }

    /// The search; returns the fitted laws.
    fn run(&self, result: &mut ChannelResult) -> Vec<Term> {
        let selection = self.select(result);
        result.minimum.extend(self.minimum());
        let laws = self.report(selection, result);
        consider_both(result);
        laws
    }

    /// Variances over some frames.
    fn table(&self, frames: &[usize]) -> NoiseTable {
        NoiseTable::new(total(frames.iter().map(|&i| &self.rough[i])), self.least_cos)
    }

    /// Fit of some laws on the selecting frames.
    fn whole(&self, columns: &[usize]) -> LinearFit {
        fit(&self.linear.iter().collect::<Vec<_>>(), &self.blocks, columns, &NO_PRIOR)
    }

    /// Detectable effect sizes: significant, and large enough to be reported.
    fn minimum(&self) -> Vec<(Cause, Minimum)> {
        let least = |law: usize| {
            let significant = Z_STAR * self.whole(&[law]).error(0);
            // In steps of 2 %.
            let sizes: Vec<f64> = (0..1500).map(|k| 1e-12 * 1.02f64.powi(k)).collect();
            let first = sizes.partition_point(|theta| !self.above_floor(NOISE_LAWS[law], *theta));
            significant.max(sizes.get(first).copied().unwrap_or(0.0)).sqrt()
        };
        vec![
            (Cause::RangeNoise, Minimum::new(Quantity::StdM, least(CONSTANT))),
            (Cause::AngularJitter, Minimum::new(Quantity::StdDeg, least(ANGULAR).to_degrees())),
        ]
    }

    /// Whether a law with a coefficient adds enough noise to be reported.
    fn above_floor(&self, law: NoiseLaw, theta: f64) -> bool {
        // Returns weighted by the inverse of the simulated variance: what counts is where the law is best seen.
        let (mut share, mut along, mut n) = (0.0, 0.0, 0.0);
        for (range, cos, returns, [_, vb]) in self.table.rows() {
            let added = theta.abs() * law.variance(range, cos);
            let w = returns / vb;
            share += returns * (added / vb).min(1.0);
            along += w * added;
            n += returns;
        }
        let typical = self.table.rows().iter().map(|r| r.2 / r.3[1]).sum::<f64>();
        let added_m2 = along / typical.max(1e-12);
        let enough = match law {
            NoiseLaw::Angular => theta.abs().sqrt() > JITTER_RAD,
            _ => added_m2.sqrt() > NOISE_M,
        };
        // Surfaces that heavy tails draw are uneven alike at all angles of incidence.
        let drawn = !matches!(law, NoiseLaw::Angular) && added_m2 < self.drawn_m2;
        enough && !drawn && share / n.max(1.0) > NOISE_SHARE
    }

    /// Fits what was chosen on the estimating frames and measures it on the held-out ones. Returns the fitted laws.
    fn report(&self, selection: Selection, result: &mut ChannelResult) -> Vec<Term> {
        let on_estimate = self.table(&self.estimate);
        let linear: Vec<LinearFrame> =
            self.estimate.iter().map(|&i| on_estimate.linear(&self.rough[i], &NOISE_LAWS)).collect();
        let blocks = self.context.blocks(&self.estimate);
        let fitted = fit(&linear.iter().collect::<Vec<_>>(), &blocks, &selection.laws, &NO_PRIOR);
        let on_hold_out = self.table(&self.hold_out);
        let terms: Vec<Term> =
            selection.laws.iter().zip(fitted.theta.iter()).map(|(&k, &t)| (NOISE_LAWS[k], t)).collect();
        for (k, selected) in selection.selected.into_iter().enumerate() {
            let without: Vec<_> = terms.iter().enumerate().filter(|(i, _)| *i != k).map(|(_, t)| *t).collect();
            // What a law brings beside the others, or alone: beside one that takes noise away it brings what that
            // takes.
            let gain = |&i: &usize| {
                let likelihood = |terms: &[Term]| on_hold_out.likelihood(&self.rough[i], terms);
                let alone = likelihood(&terms[k..=k]) - likelihood(&[]);
                alone.min(likelihood(&terms) - likelihood(&without))
            };
            let gains = self.hold_out.iter().map(gain).collect();
            let (law, theta) = terms[k];
            let causes = match law {
                // The simulation has more of it: what it has is not known here.
                NoiseLaw::Angular if theta > 0.0 => self.name_of_angular(theta.sqrt()).to_vec(),
                _ => vec![law.cause()],
            };
            result.found.push(found(&fitted, k, (causes, selected), gains, &on_hold_out, &terms));
        }
        let of_frame = |&i: &usize| distance(&on_hold_out, &on_estimate, &self.rough[i], &terms);
        for (d, more) in result.distance.iter_mut().zip(self.hold_out.iter().map(of_frame)) {
            d.iter_mut().zip(more).for_each(|(sum, m)| *sum += m);
        }
        if let Some((grouping, confidence)) = selection.unexplained {
            let mut found = self.unexplained(grouping, confidence, &on_estimate, &terms);
            for (d, g) in result.distance.iter_mut().zip(&found.held_out_gains) {
                d[1] += g;
                d[2] += g.max(0.0);
            }
            // The laws below the table are a part of it: their causes are not named.
            for (g, &i) in found.held_out_gains.iter_mut().zip(&self.hold_out) {
                *g += on_hold_out.likelihood(&self.rough[i], &terms) - on_hold_out.likelihood(&self.rough[i], &[]);
            }
            result.found.push(found);
        }
        terms
    }
}

/// Prior precisions of the laws' coefficients: none.
const NO_PRIOR: [f64; NOISE_LAWS.len()] = [0.0; NOISE_LAWS.len()];

/// Of one frame the Kullback-Leibler distance of its roughness from the simulation, the gain of the laws, and the
/// gain of the variances of `other` frames cell by cell, nats.
fn distance(table: &NoiseTable, other: &NoiseTable, frame: &RoughFrame, terms: &[Term]) -> [f64; 3] {
    let best: f64 = frame
        .iter()
        .filter_map(|(i, cell)| {
            table.variances(*i as usize)?;
            let n = cell.measured.n / 2.0;
            (n > 0.0).then(|| -0.5 * n * (cell.variances()[0].max(1e-12).ln() + 1.0))
        })
        .sum();
    let before = table.likelihood(frame, &[]);
    [best - before, table.likelihood(frame, terms) - before, table.likelihood_by_table(frame, other) - before]
}
