//! The gain through the file: frames are made anew with the effects of `extended.toml`, paired with the measured ones
//! again, and compared by the same distance.
//!
//! The distance of a channel is what lookup tables of the measured data, fitted on the estimating frames, predict
//! better of the held-out frames than the simulation does (nats a simulated return). It asks for no cause, is near zero
//! where the two sides are two draws of the same sensor, and is the same number before and after.

use super::reached::{closed_of, set_reached};
use super::report::METRIC;
use super::{Engine, curves};
use crate::catalogue::{Channel, Kind};
use crate::diagnosis::{Closed, Diagnosis, Finding, Gain, NotApplied};
use crate::error::DiagnoseError;
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
use std::path::Path;
use std::sync::Arc;

/// Frames of a role that are made anew, at most.
const FRAMES: usize = 60;

/// Nats of a channel over all held-out frames from which on the share of it that is gone is reported.
const ENOUGH_NATS: f64 = 8.0;

/// Random seeds of the two draws of the extended simulation.
pub const SEEDS: [u64; 2] = [0, 1];

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
}

/// What a distance is of: a channel, or a part of one that has causes of its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Part {
    Channel(Channel),
    /// Of a channel that is the sum over its kinds.
    Kind(Kind),
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

/// The distances of some frames of a pair.
fn distances(context: &Context, sensors: &Sensors, train: &[usize], test: &[usize], slide: bool) -> Distances {
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
    kinds.extend(lost);
    kinds.insert(Kind::Brightness, by_brightness);
    kinds.insert(Kind::Between, mixed_pixels::by_table(context, train, test));
    of_channels(distances, kinds)
}

/// At most [`FRAMES`] of some frames, evenly spread.
fn some(frames: Vec<usize>) -> Vec<usize> {
    let n = frames.len();
    if n <= FRAMES { frames } else { (0..FRAMES).map(|k| frames[k * n / FRAMES]).collect() }
}

/// A gain with the pairs of the extended simulation; no pairs where no effect could be applied.
pub(super) struct Extended {
    pub(super) gain: Gain,
    frames: Vec<FramePair>,
}

/// Distances before, after and at the floor.
pub(super) struct Verification<'a> {
    engine: &'a Engine<'a>,
    context: &'a Context<'a>,
    train: Vec<usize>,
    test: Vec<usize>,
    slide: bool,
    /// Channels in which something was found; empty for all.
    found: BTreeSet<Channel>,
    before: Distances,
}

impl<'a> Verification<'a> {
    /// Of the pair as it is, with the channels in which something was found; without any, all channels count.
    pub(super) fn new(engine: &'a Engine<'a>, context: &'a Context<'a>, found: BTreeSet<Channel>) -> Self {
        let slide = found.contains(&Channel::Slide);
        let [train, test] = [Role::Estimate, Role::HoldOut].map(|role| some(context.of(role)));
        let before = distances(context, engine.sensors, &train, &test, slide);
        Verification { engine, context, train, test, slide, found, before }
    }

    /// The distances by channel where nothing was found. The totals are of what was found: zero.
    pub(super) fn without_extension(&self) -> Gain {
        Gain { before: 0.0, after: 0.0, floor: 0.0, counted: vec![], ..self.gain(&self.before, &self.before, false) }
    }

    /// The gain by a list of effects.
    ///
    /// # Errors
    /// Files that cannot be read, and frames that cannot be made.
    pub(super) fn of(&self, effects: &EffectList, remake: &dyn Remake) -> Result<Extended, DiagnoseError> {
        let (made, refused) = remake.with(effects)?;
        let none_applied = refused.len() == effects.effects.len();
        let not_applied = refused.into_iter().map(|r| NotApplied { effect: r.kind.into(), why: r.why }).collect();
        let zero: Distances = self.before.iter().map(|(c, d)| (*c, vec![0.0; d.len()])).collect();
        if none_applied {
            let gain = Gain { not_applied, ..self.gain(&self.before, &zero, true) };
            return Ok(Extended { gain, frames: vec![] });
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
        Ok(Extended { gain: Gain { not_applied, ..self.gain(&after, &floor, true) }, frames })
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
        findings.par_iter_mut().filter(|f| !f.effects.is_empty()).for_each(|finding| {
            let closed = closed_of(&extended.gain, finding).map_or(0.0, |c| c.closed);
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
        let distances = distances(&context, self.engine.sensors, &places(&self.train), &places(&self.test), self.slide);
        Ok((distances, frames))
    }

    /// See [`GainFrames::gain`].
    fn gain(&self, after: &Distances, floor: &Distances, extended: bool) -> Gain {
        let (returns, blocks) = (self.context.returns(&self.test), self.context.blocks(&self.test));
        GainFrames { returns, blocks }.gain([&self.before, after, floor], &self.found, extended)
    }
}

/// The held-out frames of a gain.
pub(crate) struct GainFrames {
    /// Their simulated returns.
    pub(crate) returns: f64,
    /// Block of each.
    pub(crate) blocks: Vec<usize>,
}

impl GainFrames {
    /// Sums of the distances before, after and at the floor. The totals are those of the channels in which something
    /// was `found`, of all where that is empty, and of those that the extension changed.
    pub(crate) fn gain(&self, three: [&Distances; 3], found: &BTreeSet<Channel>, extended: bool) -> Gain {
        let returns = self.returns.max(1.0);
        let members = blocks_of(&self.blocks);
        // The distances of a channel over some frames. What tables predict worse than the simulation is no distance.
        let sums =
            |part: &Part, which: &[usize]| three.map(|d| which.iter().map(|&i| d[part][i]).sum::<f64>().max(0.0));
        let closed = |[before, after, floor]: [f64; 3]| (before > floor).then(|| (before - after) / (before - floor));
        let over = |parts: &[Part], which: &[usize]| {
            parts.iter().map(|c| sums(c, which)).fold([0.0; 3], |s, d| [s[0] + d[0], s[1] + d[1], s[2] + d[2]])
        };
        let all_frames: Vec<usize> = (0..self.blocks.len()).collect();
        let interval = |parts: &[Part]| {
            let mut rng = data::stream(0, "diagnose closed", 1, 0);
            let drawn = (0..REPETITIONS).filter_map(|_| closed(over(parts, &draw_blocks(&members, &mut rng))));
            interval_nearest(drawn.collect())
        };
        let channel = |part: &Part| if let Part::Channel(channel) = part { Some(*channel) } else { None };
        let kind = |part: &Part| if let Part::Kind(kind) = part { Some(*kind) } else { None };
        let changed = |part: &Part| {
            let [before, after, _] = sums(part, &all_frames);
            (after - before).abs() > ENOUGH_NATS
        };
        let found = |c: Channel| found.is_empty() || found.contains(&c);
        let all = || three[0].keys().copied();
        let counted: Vec<Part> = all().filter(|p| channel(p).is_some_and(|c| found(c) || changed(p))).collect();
        let [before, after_all, floor_all] = over(&counted, &all_frames);
        let enough = |part: &Part| {
            let [before, _, floor] = sums(part, &all_frames);
            extended && before - floor > ENOUGH_NATS
        };
        let share = |part: Part| Some(Closed { closed: closed(sums(&part, &all_frames))?, ci95: interval(&[part]) });
        let of_all = closed([before, after_all, floor_all]).filter(|_| extended);
        Gain {
            metric: METRIC.into(),
            before: before / returns,
            after: after_all / returns,
            floor: floor_all / returns,
            closed: of_all,
            ci95: of_all.and_then(|_| interval(&counted)),
            counted: counted.iter().filter_map(channel).collect(),
            channels: all().filter_map(|p| Some((channel(&p)?, sums(&p, &all_frames).map(|v| v / returns)))).collect(),
            kinds: all().filter_map(|p| Some((kind(&p)?, sums(&p, &all_frames).map(|v| v / returns)))).collect(),
            closed_by_channel: all().filter(enough).filter_map(|p| Some((channel(&p)?, share(p)?))).collect(),
            closed_by_kind: all().filter(enough).filter_map(|p| Some((kind(&p)?, share(p)?))).collect(),
            ..Gain::default()
        }
    }
}

/// Measures the gain of what was found through the text of `extended.toml`, on the pair as it was recorded.
pub(super) fn measure_gain(
    diagnosis: &mut Diagnosis,
    verification: &Verification,
    extended: &str,
    remake: &dyn Remake,
) -> Result<(), DiagnoseError> {
    let gain = match diagnosis.findings.is_empty() {
        true => verification.without_extension(),
        false => {
            let effects = EffectList::parse(extended, Path::new("extended.toml"))?;
            let extended = verification.of(&effects, remake)?;
            verification.measure_curves(&mut diagnosis.findings, &extended);
            extended.gain
        }
    };
    diagnosis.gain = Gain { predicted: diagnosis.gain.predicted.take(), ..gain };
    set_reached(diagnosis);
    Ok(())
}
