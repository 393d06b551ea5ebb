//! Returns without a simulated surface at their place: false alarms, objects that the simulation lacks.

mod describe;
mod false_alarms;
mod ghosts;
mod spray;
mod weather;

use self::describe::found;
use self::weather::Air;
use super::{ChannelResult, Context, NamedParameter, Z_STAR, with_error};
use crate::catalogue::sizes::{ALONE_SHARE, BEHIND_SHARE, GROUPED_SHARE};
use crate::catalogue::{Cause, Channel, Kind, Quantity, Unit};
use crate::channels::mean::origins;
use crate::channels::plumes::{Extent, MOST, PlumeFrame, plume_frame};
use crate::channels::returns::{ODD, Odd, OddFrame, end_m, odd_frames};
use crate::diagnosis::{Minimum, Parameter};
use crate::inference::choice::{significant, significant_by_signs, total_and_z};
use crate::inference::counts::likelihood_of_counts;
use crate::inference::linear::cross_validated;
use crate::inference::roles::Role;
use crate::pairing::{FramePair, Lies};
use geometry::Box3;
use rayon::prelude::*;
use std::collections::{BTreeMap, HashSet};

/// Smallest share of returns that is reported, by kind.
const FLOORS: [f64; 3] = [ALONE_SHARE, GROUPED_SHARE, BEHIND_SHARE];

/// Ratio of the excess in front of surfaces to the excess behind them, or the reverse, from which on objects were
/// added or are missing. Below it, surfaces stand elsewhere.
const ONE_SIDED: f64 = 3.0;

/// Sign test over frames, standard errors: to detect an excess, and to confirm it on other frames. Three are ten of
/// ten frames.
const Z_BY_SIGNS: [f64; 2] = [3.0, 2.0];

/// Smallest gain of the selecting frames, nats.
const LEAST_NATS: f64 = 8.0;

/// Whether the sides show the same scenes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scenes {
    /// The same: surfaces of the simulated side are those of the measured one.
    Same,
    /// Different streets.
    Different,
}

impl Scenes {
    /// Kinds of returns that are compared: of different streets those that each side shows by itself.
    fn kinds(self) -> &'static [Odd] {
        match self {
            Scenes::Same => &ODD,
            Scenes::Different => &[Odd::Alone],
        }
    }
}

/// The search of all kinds.
pub fn search(context: &Context, scenes: Scenes) -> ChannelResult {
    let end_m = 0.98 * end_m(context.frames);
    let [select, estimate, hold_out] = [Role::Select, Role::Estimate, Role::HoldOut].map(|r| context.of(r));
    let mut result = ChannelResult::new(Channel::Returns, hold_out.len());
    let blocks = context.blocks(&select);
    let mut spray = Vec::new();
    if scenes == Scenes::Same {
        let plumes = plumes(context);
        let returns = context.returns(&select);
        let of_estimate = |extent: Extent| {
            let origins = origins(context.rig);
            let of_frame = |&i: &usize| {
                let speed = |vehicle: &Box3| context.seen_velocity(i, vehicle)?.speed_m_s;
                plume_frame(&context.frames[i], &origins, extent, &speed)
            };
            estimate.par_iter().map(of_frame).collect()
        };
        let frames = spray::Frames {
            plumes: &plumes,
            within: &of_estimate,
            select: &select,
            blocks: &blocks,
            estimate: &estimate,
            hold_out: &hold_out,
            returns,
        };
        if spray::search(&frames, &mut result) {
            spray = plumes.into_iter().map(|p| p.around).collect();
        }
    }
    let ghosts = scenes == Scenes::Same && {
        let air = air(context, &spray, &select, end_m);
        ghosts::search(context, [&select, &estimate, &hold_out], &air, &mut result)
    };
    let explained = |frame: usize, side: usize, ray: usize| {
        is_spray(&spray, frame, side, ray) || (ghosts && lies_behind(context, frame, side, ray))
    };
    let odd = odd_frames(context.frames, end_m, &explained);
    let search = Search { context, scenes, spray, ghosts, odd, select, blocks, estimate, hold_out, end_m };
    for kind in scenes.kinds() {
        search.kind(*kind, &mut result);
    }
    result
}

/// Whether a return, by the number of its frame, its side and its place there, may be one of spray.
fn is_spray(spray: &[[HashSet<usize>; 2]], frame: usize, side: usize, ray: usize) -> bool {
    spray.get(frame).is_some_and(|of_frame| of_frame[side].contains(&ray))
}

/// Where the lone returns of some frames come from, without those of spray.
fn air(context: &Context, spray: &[[HashSet<usize>; 2]], frames: &[usize], end_m: f64) -> Air {
    let of_frames: Vec<&FramePair> = frames.iter().map(|&f| &context.frames[f]).collect();
    Air::new(&of_frames, end_m, &|f, side, ray| is_spray(spray, frames[f], side, ray))
}

/// Whether a return lies behind a simulated surface.
fn lies_behind(context: &Context, frame: usize, side: usize, ray: usize) -> bool {
    let frame = &context.frames[frame];
    [&frame.measured, &frame.simulated][side][ray].lies() == Lies::Behind
}

/// Gains of the `test` frames by the shares of odd returns of the `train` frames, and by the density of returns behind
/// vehicles, nats.
pub fn by_table(context: &Context, train: &[usize], test: &[usize]) -> BTreeMap<Kind, Vec<f64>> {
    let plumes = plumes(context);
    let around = |frame: usize, side: usize, ray: usize| plumes[frame].around[side].contains(&ray);
    let behind = |frame: usize, side: usize, ray: usize| lies_behind(context, frame, side, ray);
    let before = |f: usize, side: usize, ray: usize| around(f, side, ray) || behind(f, side, ray);
    let mut gains = shares_by_table(context, &ODD, [train, test], &before);
    let others = |f: usize, side: usize, ray: usize| around(f, side, ray) || !behind(f, side, ray);
    let of_behind = shares_by_table(context, &[Odd::Alone, Odd::GroupBehind], [train, test], &others);
    let sum = (0..test.len()).map(|i| of_behind.values().map(|of_kind| of_kind[i]).sum()).collect();
    gains.insert(Kind::Behind, sum);
    gains.insert(Kind::Plumes, spray::by_table(&plumes, train, test));
    gains
}

/// The same of different streets.
pub fn by_table_of_streets(context: &Context, train: &[usize], test: &[usize]) -> BTreeMap<Kind, Vec<f64>> {
    shares_by_table(context, Scenes::Different.kinds(), [train, test], &|_, _, _| false)
}

/// The air behind the vehicles of each frame.
fn plumes(context: &Context) -> Vec<PlumeFrame> {
    let origins = origins(context.rig);
    context.frames.par_iter().map(|f| plume_frame(f, &origins, MOST, &|_| None)).collect()
}

/// Gains by the shares of some returns, by kind, without those that are explained: see [`odd_frames`].
fn shares_by_table(
    context: &Context,
    kinds: &[Odd],
    [train, test]: [&[usize]; 2],
    explained: &(dyn Fn(usize, usize, usize) -> bool + Sync),
) -> BTreeMap<Kind, Vec<f64>> {
    let odd = odd_frames(context.frames, 0.98 * end_m(context.frames), explained);
    let rates = ODD.map(|kind| excess(train.iter().map(|&i| &odd[i]), kind as usize));
    let of_kind = |i: usize, kind: Odd| {
        let [base, more] = rates[kind as usize];
        gain(&odd[i], kind as usize, base, more)
    };
    let mut gains = BTreeMap::<Kind, Vec<f64>>::new();
    for kind in kinds {
        let Some(name) = Kind::of(cause(*kind)) else { continue };
        let of_name = gains.entry(name).or_insert_with(|| vec![0.0; test.len()]);
        of_name.iter_mut().zip(test).for_each(|(sum, &i)| *sum += of_kind(i, *kind));
    }
    gains
}

/// Counts of all frames, and the frames by role.
struct Search<'a> {
    context: &'a Context<'a>,
    scenes: Scenes,
    /// Returns that may be spray, frame by frame, of both sides; empty where there is none.
    spray: Vec<[HashSet<usize>; 2]>,
    /// Whether ghosts explain what lies behind surfaces.
    ghosts: bool,
    odd: Vec<OddFrame>,
    select: Vec<usize>,
    /// Blocks of the selecting frames.
    blocks: Vec<usize>,
    estimate: Vec<usize>,
    hold_out: Vec<usize>,
    /// Range up to which returns are counted, m.
    end_m: f64,
}

/// What the selecting frames say of one kind of returns.
struct Evidence {
    /// Total gain, nats, and its z.
    total: f64,
    z: f64,
    /// Excess of the measured side over the simulated share.
    more: f64,
    /// Smallest excess that is reported.
    floor: f64,
    /// Smallest excess that would be detected.
    detectable: f64,
    /// Whether the excess is significant.
    significant: bool,
    /// Whether the excess is on one side of surfaces.
    one_sided: bool,
}

impl Search<'_> {
    /// Excess over some frames; see [`excess`].
    fn excess(&self, frames: &[usize], kind: Odd) -> [f64; 2] {
        excess(frames.iter().map(|&i| &self.odd[i]), kind as usize)
    }

    /// Difference of the two sides' shares on each frame.
    fn differences(&self, frames: &[usize], kind: Odd) -> Vec<f64> {
        let share = |i: usize, side: usize| self.odd[i].counts[kind as usize][side] / self.odd[i].all[side].max(1.0);
        frames.iter().map(|&i| share(i, 0) - share(i, 1)).collect()
    }

    fn evidence(&self, kind: Odd) -> Evidence {
        let k = kind as usize;
        let gains = cross_gains(&self.odd, &self.select, &self.blocks, k);
        let (total, z) = total_and_z(&gains);
        let [base, more] = self.excess(&self.select, kind);
        let differences = self.differences(&self.select, kind);
        let (_, z_difference) = total_and_z(&differences);
        let error = base.max(more.abs() / 30.0) / z_difference.abs().max(1e-9);
        let floor = FLOORS[k].max(0.3 * base);
        // Missing objects of the other side would be of this kind.
        let opposite = match kind {
            Odd::GroupInFront => Some(Odd::GroupBehind),
            Odd::GroupBehind => Some(Odd::GroupInFront),
            Odd::Alone => None,
        };
        // Objects stand in few places. Where few frames have most of the excess, signs are more powerful than the
        // mean.
        let by_signs = opposite.is_some() && significant_by_signs(&differences, Z_BY_SIGNS[0]);
        let by_mean = significant(&gains, Z_STAR) && z_difference > 1.5;
        let excess_of = |other: Odd| self.excess(&self.select, other)[1].max(0.0);
        Evidence {
            total,
            z,
            more,
            floor,
            detectable: (Z_STAR * error.min(0.1)).max(floor),
            significant: total > LEAST_NATS && (by_mean || by_signs),
            one_sided: opposite.is_none_or(|other| more > ONE_SIDED * excess_of(other)),
        }
    }

    /// Searches one kind of returns.
    fn kind(&self, kind: Odd, result: &mut ChannelResult) {
        let evidence = self.evidence(kind);
        let outcome = match &evidence {
            e if !e.significant => "no more of them than on the simulated side",
            e if e.more <= e.floor => "too small to speak of",
            e if self.excess(&self.estimate, kind)[1] <= e.floor => "too small to speak of in other frames",
            e if !e.one_sided => "as many are missing elsewhere: surfaces stand elsewhere, nothing was added",
            _ => "chosen",
        };
        if outcome == "chosen" {
            self.report(kind, &evidence, result);
        }
        let returns = self.context.returns(&self.select);
        for cause in causes(kind) {
            let others = outcome == "chosen" && !result.found.iter().any(|f| f.causes.contains(cause));
            let outcome = if others { "another cause fits their ranges better" } else { outcome };
            result.consider(*cause, (evidence.total, evidence.z), returns, outcome);
        }
        if kind != Odd::GroupBehind {
            result.minimum.push((cause(kind), Minimum::new(Quantity::Share, evidence.detectable)));
        }
    }

    /// Fits an excess on the estimating frames and measures it on the held-out ones.
    fn report(&self, kind: Odd, evidence: &Evidence, result: &mut ChannelResult) {
        let k = kind as usize;
        let [base, more] = self.excess(&self.estimate, kind);
        let share = share_of(more, &self.differences(&self.estimate, kind));
        let held: Vec<f64> = self.hold_out.iter().map(|&i| gain(&self.odd[i], k, base, more)).collect();
        result.found.extend(found(self, kind, share, held, evidence.z));
        for (d, &i) in result.distance.iter_mut().zip(&self.hold_out) {
            let (before, after) = distance(&self.odd[i], k, base, more);
            *d = [d[0] + before, d[1] + before - after, d[2] + before - after];
        }
    }
}

/// Gain of grouped returns, nats a return, from which on surfaces stand elsewhere.
const ELSEWHERE_NATS: f64 = 0.01;

/// Share of that gain that may remain after surfaces were moved to their place.
const ELSEWHERE_REMAINS: f64 = 0.5;

/// Whether grouped returns lie off the simulated surfaces.
pub fn surfaces_stand_elsewhere(context: &Context) -> bool {
    grouped_gain(context) > ELSEWHERE_NATS
}

/// Whether undoing a displacement brings measured returns onto the simulated surfaces: at most half of the gain by
/// grouped returns off the surfaces is left.
pub fn is_explained_by_displacement(before: &Context, moved: &Context) -> bool {
    grouped_gain(moved) < ELSEWHERE_REMAINS * grouped_gain(before)
}

/// Gain by grouped returns off the surfaces, nats a return: objects that only one side has, or surfaces that stand
/// elsewhere.
fn grouped_gain(context: &Context) -> f64 {
    let odd = odd_frames(context.frames, 0.98 * end_m(context.frames), &|_, _, _| false);
    let select = context.of(Role::Select);
    let blocks = context.blocks(&select);
    let gain = |kind: Odd| cross_gains(&odd, &select, &blocks, kind as usize).iter().sum::<f64>().max(0.0);
    (gain(Odd::GroupInFront) + gain(Odd::GroupBehind)) / context.returns(&select).max(1.0)
}

/// The causes that a kind of returns may have.
fn causes(kind: Odd) -> &'static [Cause] {
    match kind {
        Odd::Alone => &[Cause::Outliers, Cause::Fog, Cause::Rain],
        Odd::GroupInFront | Odd::GroupBehind => &[Cause::MissingObject],
    }
}

/// The first cause of a kind of returns.
fn cause(kind: Odd) -> Cause {
    causes(kind)[0]
}

/// Share on the simulated side, and the excess of the measured side over it.
fn excess<'a>(frames: impl Iterator<Item = &'a OddFrame>, k: usize) -> [f64; 2] {
    let mut sum = [0.0; 4];
    for f in frames {
        for (s, v) in sum.iter_mut().zip([f.counts[k][0], f.counts[k][1], f.all[0], f.all[1]]) {
            *s += v;
        }
    }
    let base = (sum[1] + 0.5) / sum[3].max(1.0);
    [base, sum[0] / sum[2].max(1.0) - base]
}

/// The excess with its interval from the scatter of the frames. Where that interval contains zero but the sign test
/// confirms the excess, the interval is that of its logarithm.
fn share_of(more: f64, each: &[f64]) -> Parameter {
    let (_, z) = total_and_z(each);
    let error = (more.abs() / z.abs().max(1e-9)).hypot(0.05 * more);
    let mut share = with_error(more, error, Unit::One);
    if share.ci95[0] * share.ci95[1] <= 0.0 && more > 0.0 && significant_by_signs(each, Z_BY_SIGNS[1]) {
        let factor = (1.96 * error / more).exp();
        share.ci95 = [more / factor, more * factor];
    }
    share
}

/// Gain of a frame's counts by the excess of the measured side, nats.
fn gain(frame: &OddFrame, k: usize, base: f64, more: f64) -> f64 {
    let rate = (base + more).max(0.05 * base);
    let [measured, simulated] = frame.counts[k];
    // Where the measured side has fewer, as many of them as the world has are hidden.
    let likelihood = |rate: f64| {
        let [all, of_simulated] = frame.all;
        let alike = [[rate.min(base) * all], [base * of_simulated]];
        likelihood_of_counts([&[measured], &[simulated]], [&alike[0], &alike[1]], &[(rate - base).max(0.0) * all])
    };
    likelihood(rate) - likelihood(base)
}

/// Kullback-Leibler distance of a frame's count from the simulated share, and from that with the excess, nats.
fn distance(frame: &OddFrame, k: usize, base: f64, more: f64) -> (f64, f64) {
    let from = |rate: f64| poisson_distance(frame.counts[k][0], frame.all[0] * rate);
    (from(base), from((base + more).max(0.05 * base)))
}

/// Kullback-Leibler distance of a count from what is expected, nats.
fn poisson_distance(count: f64, expected: f64) -> f64 {
    let expected = expected.max(1e-6);
    (if count > 0.0 { count * (count / expected).ln() } else { 0.0 }) - (count - expected)
}

/// Cross-validated gains of the selecting frames, nats.
fn cross_gains(odd: &[OddFrame], select: &[usize], blocks: &[usize], k: usize) -> Vec<f64> {
    let fit = |train: &[usize]| excess(train.iter().map(|&i| &odd[select[i]]), k);
    cross_validated(blocks, fit, |[base, more], i| gain(&odd[select[i]], k, *base, more.max(0.0)))
}
