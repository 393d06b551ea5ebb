//! The gain through the file: frames are made anew with the effects of `extended.toml`, paired with the measured ones
//! again, and compared by the same distance.
//!
//! The distance of a channel is what lookup tables of the measured data, fitted on the estimating frames, predict
//! better of the held-out frames than the simulation does (nats a simulated return). It asks for no cause, is near zero
//! where the two sides are two draws of the same sensor, and is the same number before and after.

mod view;

pub use view::{Discrepancy, Switch, View, ViewState};

use super::reached::{Reached, closed_of};
use super::report::METRIC;
use super::{Engine, curves};
use crate::catalogue::{Channel, Kind};
use crate::channels::mask::DirectionCell;
use crate::diagnosis::{Closed, Finding, Gain, NotApplied};
use crate::error::DiagnoseError;
use crate::inference::evenly_spread;
use crate::inference::roles::Role;
use crate::pairing::{Corrections, FramePair, Recordings, SideFrame, kept_of_frame, pair_all};
use crate::search::labels::Side;
use crate::search::{
    Context, REPETITIONS, geometry, hits, intensity, labels, mixed_pixels, noise, packets, quantisation, returns,
    rolling_shutter,
};
use data::{Cloud, Dataset, Object};
use rayon::prelude::*;
use sensor::directions::Sensors;
use sensor::finished::{FinishedDataset, Refusal};
use sensor::{EffectList, Rig};
use statistics::{blocks_of, draw_blocks, interval_nearest};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Frames of a role that are made anew, at most.
const FRAMES: usize = 60;

/// Nats of a channel over all held-out frames from which on the share of it that is gone is reported.
const ENOUGH_NATS: f64 = 8.0;

/// Random seeds of the two draws of the extended simulation.
pub const SEEDS: [u64; 2] = [0, 1];

/// Frames with effects, and those of the effects that cannot be applied.
type Prepared<'a> = (Box<dyn RemadeFrames + 'a>, Vec<Refusal>);

/// Makes frames of the simulation anew.
pub trait Remake: Sync {
    /// Prepares frames with those of the effects that can be applied, and says which cannot.
    ///
    /// # Errors
    /// Files that cannot be read.
    fn with<'s>(&'s self, effects: &EffectList) -> Result<(Box<dyn RemadeFrames + 's>, Vec<Refusal>), DiagnoseError>;
}

/// Frames of the simulation with effects.
pub trait RemadeFrames: Sync {
    /// Cloud and objects of a frame, once for each of [`SEEDS`].
    ///
    /// # Errors
    /// Files that cannot be read, and frames that cannot be made.
    fn frame(&self, id: &str) -> Result<[(Cloud, Vec<Object>); 2], DiagnoseError>;

    /// A frame for the first of [`SEEDS`], with `effects` in place of those that were prepared: some of them.
    ///
    /// # Errors
    /// As above.
    fn frame_with(&self, effects: &EffectList, id: &str) -> Result<(Cloud, Vec<Object>), DiagnoseError>;
}

/// Applies effects to the finished clouds, as `lidarshift resim` does.
pub struct OnClouds<'a> {
    /// The simulated data set.
    pub simulated: &'a Dataset,
    /// Its sensors.
    pub rig: &'a Rig,
}

struct CloudsWith<'a> {
    finished: FinishedDataset<'a>,
    effects: EffectList,
}

impl Remake for OnClouds<'_> {
    fn with<'s>(&'s self, effects: &EffectList) -> Result<(Box<dyn RemadeFrames + 's>, Vec<Refusal>), DiagnoseError> {
        let finished = FinishedDataset::open(self.simulated, Some(self.rig), effects)?;
        let refused = finished.refusals(effects);
        let effects = effects.without(&refused);
        Ok((Box::new(CloudsWith { finished: finished.for_effects(&effects), effects }), refused))
    }
}

impl RemadeFrames for CloudsWith<'_> {
    fn frame(&self, id: &str) -> Result<[(Cloud, Vec<Object>); 2], DiagnoseError> {
        let frames = self.finished.frames(&self.effects, SEEDS, id)?;
        Ok(frames.map(|(frame, _)| (frame.cloud, frame.objects)))
    }

    fn frame_with(&self, effects: &EffectList, id: &str) -> Result<(Cloud, Vec<Object>), DiagnoseError> {
        let (frame, _) = self.finished.frame(effects, SEEDS[0], id)?;
        Ok((frame.cloud, frame.objects))
    }
}

/// What a distance is of: a channel, or a part of one that has causes of its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Part {
    Channel(Channel),
    /// Of a channel that is the sum over its kinds.
    Kind(Kind),
    /// The directions in which a finding acts, by its number.
    Place(usize),
}

/// Distances of the held-out frames, nats, frame by frame.
pub(crate) type Distances = BTreeMap<Part, Vec<f64>>;

/// The distances of all channels. Those of channels with kinds are summed over them.
pub(crate) fn of_channels(
    channels: impl IntoIterator<Item = (Channel, Vec<f64>)>,
    kinds: BTreeMap<Kind, Vec<f64>>,
) -> Distances {
    let mut all: Distances = channels.into_iter().map(|(channel, d)| (Part::Channel(channel), d)).collect();
    for (kind, of_kind) in kinds {
        let sum = all.entry(Part::Channel(kind.channel())).or_insert_with(|| vec![0.0; of_kind.len()]);
        sum.iter_mut().zip(&of_kind).for_each(|(sum, d)| *sum += d);
        all.insert(Part::Kind(kind), of_kind);
    }
    all
}

/// The distances of some frames of a pair, with those of some directions.
fn distances(
    context: &Context,
    sensors: &Sensors,
    [train, test]: [&[usize]; 2],
    slide: bool,
    places: &Places,
) -> Distances {
    // Each side loses its own packets: only their number is compared.
    let packets = packets::Packets::new(context, sensors);
    let arrived = packets.arrived(context.frames);
    let context = &Context { frames: arrived.as_deref().unwrap_or(context.frames), ..context.clone() };
    let others: [(Channel, &(dyn Fn() -> Vec<f64> + Sync)); 8] = [
        (Channel::Residuals, &|| geometry::by_table(context, train, test)),
        (Channel::Packets, &|| packets.by_table(train, test)),
        (Channel::Roughness, &|| noise::by_table(context, train, test)),
        (Channel::Ranges, &|| quantisation::by_table(context, train, test)),
        (Channel::Intensity, &|| intensity::by_table(context, train, test)),
        (Channel::Labels, &|| labels::by_table(context, Side::Labels, train, test)),
        (Channel::Objects, &|| labels::by_table(context, Side::Objects, train, test)),
        (Channel::Slide, &|| rolling_shutter::by_table(context, train, test)),
    ];
    let asked = others.into_par_iter().filter(|(channel, _)| slide || *channel != Channel::Slide);
    let distances: Vec<_> = asked.map(|(channel, distance)| (channel, distance())).collect();
    let (mut kinds, (lost, by_brightness)) = rayon::join(
        || returns::by_table(context, train, test),
        || rayon::join(|| hits::by_table(context, train, test), || geometry::walk::by_table(context, train, test)),
    );
    kinds.extend(lost.kinds());
    kinds.insert(Kind::Brightness, by_brightness);
    kinds.insert(Kind::Between, mixed_pixels::by_table(context, train, test));
    let mut all = of_channels(distances, kinds);
    all.extend(places.iter().map(|(number, cells)| (Part::Place(*number), lost.within(cells))));
    all
}

/// A gain with the pairs of the extended simulation; no pairs where no effect could be applied.
pub(super) struct Extended {
    pub(super) gain: Gain,
    /// What is gone in the directions of findings, by their number.
    pub(super) places: BTreeMap<usize, Reached>,
    frames: Vec<FramePair>,
}

/// Cells of the directions in which findings act, by their number; those that act in all directions are left out.
pub(super) type Places = BTreeMap<usize, BTreeSet<DirectionCell>>;

/// Distances before, after and at the floor.
pub(super) struct Verification<'a> {
    engine: &'a Engine<'a>,
    context: &'a Context<'a>,
    train: Vec<usize>,
    test: Vec<usize>,
    slide: bool,
    /// Channels in which something was found; empty for all.
    found: BTreeSet<Channel>,
    places: Places,
    before: Distances,
}

impl<'a> Verification<'a> {
    /// Of the pair as it is, with the channels in which something was found; without any, all channels count.
    pub(super) fn new(
        engine: &'a Engine<'a>,
        context: &'a Context<'a>,
        found: BTreeSet<Channel>,
        places: Places,
    ) -> Self {
        let slide = found.contains(&Channel::Slide);
        let [train, test] = [Role::Estimate, Role::HoldOut].map(|role| evenly_spread(&context.of(role), FRAMES));
        let before = distances(context, engine.sensors, [&train, &test], slide, &places);
        Verification { engine, context, train, test, slide, found, places, before }
    }

    /// The distances by channel where nothing was found. The totals are of what was found: zero.
    pub(super) fn without_extension(&self) -> Gain {
        Gain { before: 0.0, after: 0.0, floor: 0.0, counted: vec![], ..self.gain(&self.before, &self.before, false) }
    }

    /// The gain by a list of effects, which frames are prepared for.
    ///
    /// # Errors
    /// Files that cannot be read, and frames that cannot be made.
    pub(super) fn of(&self, effects: &EffectList, (made, refused): &Prepared) -> Result<Extended, DiagnoseError> {
        let none_applied = refused.len() == effects.effects.len();
        let not_applied = |r: &Refusal| NotApplied { effect: r.kind.into(), why: r.why.clone() };
        let not_applied = refused.iter().map(not_applied).collect();
        let zero: Distances = self.before.iter().map(|(c, d)| (*c, vec![0.0; d.len()])).collect();
        if none_applied {
            let gain = Gain { not_applied, ..self.gain(&self.before, &zero, true) };
            return Ok(Extended { gain, places: BTreeMap::new(), frames: vec![] });
        }
        let which = self.used();
        let recordings = self.engine.recordings;
        let two = |&frame: &usize| -> Result<[Arc<SideFrame>; 2], DiagnoseError> {
            let frames = made.frame(recordings.id(frame))?;
            Ok(frames.map(|(cloud, objects)| Arc::new(SideFrame::new(&cloud, objects, self.context.rig))))
        };
        let sides: Vec<Result<[Arc<SideFrame>; 2], DiagnoseError>> = which.par_iter().map(two).collect();
        let sides: Vec<[Arc<SideFrame>; 2]> = sides.into_iter().collect::<Result<_, _>>()?;
        let [one, other]: [Vec<Arc<SideFrame>>; 2] =
            [0, 1].map(|k: usize| sides.iter().map(|pair| pair[k].clone()).collect());
        let (after, frames) = self.distances_of(&which, &recordings.with_sides(&which, None, &one)?)?;
        let (floor, _) = self.distances_of(&which, &recordings.with_sides(&which, Some(&other), &one)?)?;
        let three = [&self.before, &after, &floor];
        let of_place = |&number: &usize| Some((number, self.frames().reached(three, Part::Place(number))?));
        let places = self.places.keys().filter_map(of_place).collect();
        Ok(Extended { gain: Gain { not_applied, ..self.gain(&after, &floor, true) }, places, frames })
    }

    /// Least distance that counts, nats a simulated return.
    pub(super) fn least(&self) -> f64 {
        ENOUGH_NATS / self.frames().returns.max(1.0)
    }

    /// The frames that are made anew, in order.
    fn used(&self) -> Vec<usize> {
        let mut all = [self.train.clone(), self.test.clone()].concat();
        all.sort_unstable();
        all
    }

    /// Measures the curves of findings on the frames that were made anew.
    pub(super) fn measure_curves(&self, findings: &mut [Finding], extended: &Extended) {
        if extended.frames.is_empty() {
            return;
        }
        let recorded: Vec<&FramePair> = self.used().into_iter().map(|i| &self.context.frames[i]).collect();
        findings.par_iter_mut().enumerate().filter(|(_, f)| !f.effects.is_empty()).for_each(|(number, finding)| {
            let closed = closed_of(&extended.gain, extended.places.get(&number), finding).map_or(0.0, |c| c.closed);
            curves::measure(finding, &recorded, &extended.frames, closed);
        });
    }

    /// Distances of frames that were made anew.
    fn distances_of(
        &self,
        which: &[usize],
        recordings: &Recordings,
    ) -> Result<(Distances, Vec<FramePair>), DiagnoseError> {
        let kept = kept_of_frame(self.context.frames.len());
        let frames: Vec<FramePair> = pair_all(recordings, self.engine.sensors, Corrections::default(), kept, &|_| ())?;
        let to_next = |w: &[usize]| self.context.to_next.get(w[0]).copied().flatten().filter(|_| w[1] == w[0] + 1);
        let context = Context {
            rig: self.context.rig,
            frames: &frames,
            roles: which.iter().map(|&i| self.context.roles[i]).collect(),
            times: self.context.times.as_ref().map(|t| which.iter().map(|&i| t[i]).collect()),
            motion: self.context.motion.as_ref().map(|m| which.iter().map(|&i| m[i]).collect()),
            to_next: which.windows(2).map(to_next).collect(),
        };
        let places = |frames: &[usize]| -> Vec<usize> {
            frames.iter().filter_map(|frame| which.iter().position(|own| own == frame)).collect()
        };
        let [train, test] = [&self.train, &self.test].map(|frames| places(frames));
        let distances = distances(&context, self.engine.sensors, [&train, &test], self.slide, &self.places);
        Ok((distances, frames))
    }

    /// See [`GainFrames::gain`].
    fn gain(&self, after: &Distances, floor: &Distances, extended: bool) -> Gain {
        self.frames().gain([&self.before, after, floor], &self.found, extended)
    }

    fn frames(&self) -> GainFrames {
        GainFrames { returns: self.context.returns(&self.test), blocks: self.context.blocks(&self.test) }
    }
}

/// The held-out frames of a gain.
pub(crate) struct GainFrames {
    /// Their simulated returns.
    pub(crate) returns: f64,
    /// Block of each.
    pub(crate) blocks: Vec<usize>,
}

/// Distances before, after and at the floor, frame by frame.
type Three<'a> = [&'a Distances; 3];

/// Share of a distance that is gone; `None` where there is none beyond the floor.
fn closed([before, after, floor]: [f64; 3]) -> Option<f64> {
    (before > floor).then(|| (before - after) / (before - floor))
}

/// Sums of the distances of some parts over some frames. What tables predict worse than the simulation is no distance.
fn sums(three: Three, parts: &[Part], which: &[usize]) -> [f64; 3] {
    let of_part = |part: &Part| three.map(|d| which.iter().map(|&i| d[part][i]).sum::<f64>().max(0.0));
    parts.iter().map(of_part).fold([0.0; 3], |s, d| [s[0] + d[0], s[1] + d[1], s[2] + d[2]])
}

impl GainFrames {
    /// Sums over all frames.
    fn all(&self, three: Three, parts: &[Part]) -> [f64; 3] {
        sums(three, parts, &(0..self.blocks.len()).collect::<Vec<_>>())
    }

    /// Interval of the share that is gone, over blocks of frames.
    fn interval(&self, three: Three, parts: &[Part]) -> Option<[f64; 2]> {
        let members = blocks_of(&self.blocks);
        let mut rng = data::stream(0, "diagnose closed", 1, 0);
        let drawn = (0..REPETITIONS).filter_map(|_| closed(sums(three, parts, &draw_blocks(&members, &mut rng))));
        interval_nearest(drawn.collect())
    }

    /// What is gone of a part, where there is enough of it; with its distances, nats a return.
    fn reached(&self, three: Three, part: Part) -> Option<Reached> {
        let all = self.all(three, &[part]);
        let share = closed(all).filter(|_| all[0] - all[2] > ENOUGH_NATS)?;
        let closed = Closed { closed: share, ci95: self.interval(three, &[part]) };
        Some(Reached { distances: all.map(|nats| nats / self.returns.max(1.0)), closed })
    }

    /// Sums of the distances before, after and at the floor. The totals are those of the channels in which something
    /// was `found`, of all where that is empty, and of those that the extension changed.
    pub(crate) fn gain(&self, three: Three, found: &BTreeSet<Channel>, extended: bool) -> Gain {
        let per_return = |nats: f64| nats / self.returns.max(1.0);
        let channel = |part: Part| if let Part::Channel(channel) = part { Some(channel) } else { None };
        let kind = |part: Part| if let Part::Kind(kind) = part { Some(kind) } else { None };
        let changed = |part: &Part| {
            let [before, after, _] = self.all(three, &[*part]);
            (after - before).abs() > ENOUGH_NATS
        };
        let found = |c: Channel| found.is_empty() || found.contains(&c);
        let parts = || three[0].keys().copied();
        let counted: Vec<Part> = parts().filter(|p| channel(*p).is_some_and(|c| found(c) || changed(p))).collect();
        let all = self.all(three, &counted);
        let [before, after, floor] = all.map(per_return);
        let of_all = closed(all).filter(|_| extended);
        let distances = |part: Part| self.all(three, &[part]).map(per_return);
        let share = |part: Part| self.reached(three, part).filter(|_| extended).map(|reached| reached.closed);
        Gain {
            metric: METRIC.into(),
            before,
            after,
            floor,
            closed: of_all,
            ci95: of_all.and_then(|_| self.interval(three, &counted)),
            counted: counted.iter().filter_map(|p| channel(*p)).collect(),
            channels: parts().filter_map(|p| Some((channel(p)?, distances(p)))).collect(),
            kinds: parts().filter_map(|p| Some((kind(p)?, distances(p)))).collect(),
            closed_by_channel: parts().filter_map(|p| Some((channel(p)?, share(p)?))).collect(),
            closed_by_kind: parts().filter_map(|p| Some((kind(p)?, share(p)?))).collect(),
            ..Gain::default()
        }
    }
}
