//! The search of each channel: hypotheses are compared on the selecting frames, fitted on the estimating frames, and
//! their gain is measured on the held-out frames.

pub mod bright_targets;
pub mod confounders;
pub mod dual_returns;
pub mod geometry;
pub mod hits;
pub mod intensity;
pub mod labels;
pub mod mask;
pub mod mixed_pixels;
pub mod noise;
pub mod packets;
mod patch;
pub mod quantisation;
pub mod returns;
pub mod rolling_shutter;
mod unexplained;

use crate::catalogue::{Cause, Channel, Covariate, Family, ParameterId, Quantity, Unit};
use crate::channels::groups::Grouping;
use crate::channels::labels::seen_velocity;
use crate::channels::moments::Moments;
use crate::channels::motion::{OwnMotion, SeenVelocity};
use crate::curve::Curve;
use crate::diagnosis::{Considered, FindingGain, Minimum, Parameter, Status};
use crate::inference::choice::{Choice, Demands, Trial, choose, total_and_z};
use crate::inference::roles::Role;
use crate::pairing::FramePair;
use ::geometry::Box3;
use sensor::Rig;
use statistics::{blocks_of, draw_blocks, interval_nearest};

/// Input that all searches share.
#[derive(Clone)]
pub struct Context<'a> {
    /// Sensors.
    pub rig: &'a Rig,
    /// Frames in order.
    pub frames: &'a [FramePair],
    /// Role and block of each.
    pub roles: Vec<(Role, usize)>,
    /// Times of the frames, s, where their ids give them.
    pub times: Option<Vec<f64>>,
    /// Ego motion at each frame, where it can be estimated.
    pub motion: Option<Vec<Option<OwnMotion>>>,
    /// Ego motion from each frame to the next, where it can be estimated.
    pub to_next: Vec<Option<OwnMotion>>,
}

impl Context<'_> {
    /// Numbers of the frames of a role, in order.
    pub fn of(&self, role: Role) -> Vec<usize> {
        (0..self.frames.len()).filter(|&i| self.roles[i].0 == role).collect()
    }

    /// Blocks of these frames.
    pub fn blocks(&self, frames: &[usize]) -> Vec<usize> {
        frames.iter().map(|&i| self.roles[i].1).collect()
    }

    /// Ego motion at each frame, at rest where it is not known; `None` where all are.
    pub fn driving(&self) -> Option<Vec<OwnMotion>> {
        let at_rest = OwnMotion::ahead(0.0);
        let motions: Vec<OwnMotion> = self.motion.as_ref()?.iter().map(|own| own.unwrap_or(at_rest)).collect();
        motions.iter().any(|own| own.speed_m_s().abs() > DRIVING_M_S).then_some(motions)
    }

    /// Time and ego motion of each frame.
    pub fn moments(&self) -> Moments {
        Moments::new(self.frames.len(), self.times.as_deref(), self.driving())
    }

    /// Velocity of a simulated box of a frame, where times are known and the same object is seen in frames beside it.
    pub fn seen_velocity(&self, frame: usize, bbox: &Box3) -> Option<SeenVelocity> {
        seen_velocity(self.frames, self.times.as_ref()?, frame, bbox, &self.to_next)
    }

    /// Simulated returns of these frames.
    pub fn returns(&self, frames: &[usize]) -> f64 {
        frames.iter().map(|&i| self.frames[i].simulated.len() as f64).sum()
    }
}

/// Speed from which on a vehicle is not at rest, m/s.
const DRIVING_M_S: f64 = 1.0;

/// A difference that a search found, before the results of all channels are put together.
#[derive(Clone, Debug)]
pub struct Found {
    /// Whether it has a name.
    pub status: Status,
    /// The cause, or the candidates with the one first whose parameters these are.
    pub causes: Vec<Cause>,
    /// Parameters by name.
    pub parameters: Vec<NamedParameter>,
    /// Share of bootstrap repetitions with the same choice.
    pub confidence: f64,
    /// Channel.
    pub channel: Channel,
    /// Covariate.
    pub covariate: Covariate,
    /// Gain on held-out frames, nats, frame by frame in their order.
    pub held_out_gains: Vec<f64>,
    /// The finding in a sentence.
    pub says: String,
    /// What to record to tell the candidates apart.
    pub separate_by: Option<String>,
    /// Plot.
    pub curve: Curve,
    /// Its effects as they were fitted, where the parameters alone do not give them; else none.
    pub effects: Vec<sensor::Effect>,
}

impl Found {
    /// Whether it has this cause, and no other.
    pub fn is(&self, cause: Cause) -> bool {
        self.causes == [cause]
    }

    /// Family of its first cause.
    pub fn family(&self) -> Family {
        self.causes.first().map_or(Family::Unknown, |c| c.family())
    }

    /// One of its parameters.
    pub fn parameter(&self, quantity: Quantity) -> Option<&Parameter> {
        self.parameters.iter().find(|(id, _)| *id == ParameterId::Of(quantity)).map(|(_, p)| p)
    }
}

/// What the search of one channel returns.
#[derive(Clone, Debug)]
pub struct ChannelResult {
    /// The channel.
    pub channel: Channel,
    /// Findings.
    pub found: Vec<Found>,
    /// Hypotheses and what became of them.
    pub considered: Vec<Considered>,
    /// Detectable effect sizes.
    pub minimum: Vec<(Cause, Minimum)>,
    /// On held-out frames, frame by frame, nats: distance of the simulation, gain of the findings, and gain of
    /// unconstrained lookup tables fitted on the same frames as the findings.
    pub distance: Vec<[f64; 3]>,
    /// Corrections of measured labels.
    pub repairs: Vec<Repair>,
}

impl ChannelResult {
    /// Lists a cause that was looked for: its gain, nats, with z, of frames with so many returns.
    pub fn consider(&mut self, cause: Cause, (nats, z): (f64, f64), returns: f64, outcome: &str) {
        let nats_per_ray = nats / returns.max(1.0);
        let channel = self.channel;
        self.considered.push(Considered { cause: cause.into(), channel, nats_per_ray, z, outcome: outcome.into() });
    }

    /// Without any finding, for a number of held-out frames.
    pub fn new(channel: Channel, hold_out: usize) -> Self {
        ChannelResult {
            channel,
            found: Vec::new(),
            considered: Vec::new(),
            minimum: Vec::new(),
            distance: vec![[0.0; 3]; hold_out],
            repairs: Vec::new(),
        }
    }
}

/// Correction of a measured label.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Repair {
    /// Number of the frame.
    pub frame: usize,
    /// Number of the object in the frame.
    pub object: usize,
    /// Shift to apply, in the cloud's frame, m: the estimate, and that with all coefficients the square root of three
    /// standard errors closer to zero and farther from it.
    pub shifts_m: [[f64; 3]; 3],
}

/// Mean gain over its standard error that a finding must exceed. No null case of the blind set reached it.
pub const Z_STAR: f64 = 3.2;

/// What the first step of a forward selection demands.
pub fn first_demands() -> Demands {
    Demands { z: Z_STAR, nats: 8.0, slack: 0.02, richer: 0.02, of_few: false }
}

/// Smallest gain of a table by direction on top of laws, as a share of their gain: the form of a law is never exactly
/// that of the sensor, and what it leaves depends on direction as ranges and angles of incidence do.
pub const UNEXPLAINED_SHARE: f64 = 0.02;

/// Share of groups, those with the largest offsets, that are left out of the spread. Rows: a single row may follow
/// the upper edge of a wall, which every shift of the wall displaces.
pub fn trimmed(grouping: Grouping) -> f64 {
    if grouping == Grouping::Row { 0.12 } else { 0.0 }
}

/// Displacement of the fastest objects over one scan from which on motion distortion spoils the other channels, m.
const SWEPT_M: f64 = 0.8;

/// Removes findings of other channels where objects show strong motion distortion that was not undone: the whole scene
/// is sheared, so that surfaces, silhouettes and directions do not match. Returns a note about what was removed.
pub fn set_aside(results: &mut [ChannelResult]) -> Option<String> {
    let of_objects = |f: &Found| f.channel == Channel::Objects && f.is(Cause::RollingShutter);
    let found = results.iter().flat_map(|r| &r.found).find(|f| of_objects(f))?;
    let scan_s = found.parameter(Quantity::ScanS)?.estimate.abs();
    let fastest = found.curve.points.iter().map(|p| p.x.abs()).fold(0.0, f64::max);
    // Vehicles drive at tens of m/s over the ground, whatever their velocity relative to the sensor.
    if scan_s * fastest.max(20.0) < SWEPT_M {
        return None;
    }
    let mut set_aside = Vec::new();
    for result in results.iter_mut() {
        let sheared =
            |f: &Found| matches!(f.channel, Channel::Residuals | Channel::Hits | Channel::Roughness | Channel::Returns);
        let first = |f: &Found| f.causes.first().copied().unwrap_or(Cause::Unexplained);
        set_aside.extend(result.found.iter().filter(|f| sheared(f)).map(|f| first(f).name()));
        result.found.retain(|f| !sheared(f));
        if result.found.is_empty() {
            result.distance.iter_mut().for_each(|d| *d = [0.0; 3]);
        }
    }
    set_aside.sort();
    set_aside.dedup();
    let list = set_aside.join(", ");
    (!set_aside.is_empty()).then(|| {
        format!("the scan takes its time and shears the whole scene: what that does in other channels ({list}) was set aside; correct the scans and diagnose again")
    })
}

/// Number of bootstrap repetitions.
pub const REPETITIONS: usize = 400;

/// Share of block-bootstrap repetitions of the gains that choose the same cause.
pub fn confidence(trials: &[Trial], blocks: &[usize], chosen: Cause, demands: &Demands) -> f64 {
    let members = blocks_of(blocks);
    let mut rng = data::stream(0, "diagnose confidence", trials.len() as u64, 0);
    let repetitions = 200;
    let same = (0..repetitions)
        .filter(|_| {
            let drawn = draw_blocks(&members, &mut rng);
            let again: Vec<Trial> = trials
                .iter()
                .map(|t| Trial { gains: drawn.iter().map(|&i| t.gains[i]).collect(), expected: vec![], ..t.clone() })
                .collect();
            let easier = Demands { z: 0.0, nats: 0.0, ..*demands };
            choose(&again, &easier).is_some_and(|c| again[c.chosen].cause == chosen)
        })
        .count();
    same as f64 / f64::from(repetitions)
}

/// Share of bootstrap repetitions below which the runner-up is reported as a candidate.
const SURE: f64 = 0.8;

/// The rival causes of a chosen one and its confidence. Without rivals the runner-up becomes one where the confidence
/// is low.
pub fn rivals_and_confidence(
    mut rivals: Vec<Cause>,
    trials: &[Trial],
    blocks: &[usize],
    chosen: Cause,
    demands: &Demands,
) -> Selected {
    let confidence = confidence(trials, blocks, chosen, demands);
    if rivals.is_empty() && confidence < SURE {
        let others = trials.iter().filter(|t| t.cause != chosen && t.above_floor);
        let runner_up = others.max_by(|a, b| total_and_z(&a.gains).0.total_cmp(&total_and_z(&b.gains).0));
        rivals.extend(runner_up.map(|t| t.cause));
    }
    Selected { rivals, confidence }
}

/// Interval of the mean of per-frame values by a bootstrap over blocks, divided by `per`.
pub fn mean_interval(values: &[f64], blocks: &[usize], per: f64) -> FindingGain {
    let members = blocks_of(blocks);
    let mut rng = data::stream(0, "diagnose interval", values.len() as u64, 0);
    let sums: Vec<f64> = (0..REPETITIONS)
        .map(|_| {
            let drawn = draw_blocks(&members, &mut rng);
            drawn.iter().map(|&i| values[i]).sum::<f64>() / drawn.len().max(1) as f64 * values.len() as f64 / per
        })
        .collect();
    FindingGain { nats_per_ray: values.iter().sum::<f64>() / per, ci95: interval_nearest(sums).unwrap_or_default() }
}

/// What a step of the selection says beside the chosen hypothesis.
#[derive(Clone, Debug, PartialEq)]
pub struct Selected {
    /// Other causes that explain as much, as far as these frames tell.
    pub rivals: Vec<Cause>,
    /// Share of bootstrap repetitions that choose the same cause.
    pub confidence: f64,
}

impl Selected {
    /// Whether the cause is certain.
    pub fn status(&self) -> Status {
        if self.rivals.is_empty() { Status::Named } else { Status::Ambiguous }
    }

    /// The chosen cause with its rivals.
    pub fn causes(self, chosen: Cause) -> Vec<Cause> {
        std::iter::once(chosen).chain(self.rivals).collect()
    }
}

/// The causes of some trials, each once.
pub fn causes_of(trials: &[Trial], which: &[usize]) -> Vec<Cause> {
    let mut causes: Vec<Cause> = which.iter().map(|&i| trials[i].cause).collect();
    causes.sort();
    causes.dedup();
    causes
}

/// Records what became of every trial.
pub fn record(
    trials: &[Trial],
    choice: Option<&Choice>,
    channel: Channel,
    rays: f64,
    demands: &Demands,
) -> Vec<Considered> {
    let line = |(i, t): (usize, &Trial)| {
        let (total, z) = t.total_and_z();
        let outcome = match choice {
            Some(c) if c.chosen == i => "chosen".to_owned(),
            Some(c) if c.equals.contains(&i) => "explains as much, or nearly so, as far as these frames tell".into(),
            _ if !t.gains_enough(demands) => "no gain on frames that it was not fitted on".into(),
            _ if !t.above_floor => "too small to speak of".into(),
            Some(c) => {
                let (best, _) = total_and_z(&trials[c.chosen].gains);
                if total >= best * 0.98 { "gains no more, with more parameters".into() } else { "gains less".into() }
            }
            None => "not chosen".into(),
        };
        Considered { cause: t.cause.into(), channel, nats_per_ray: total / rays, z, outcome }
    };
    trials.iter().enumerate().map(line).collect()
}

/// A parameter with its name.
pub type NamedParameter = (ParameterId, Parameter);

/// A parameter with a symmetric interval of 1.96 standard errors.
pub fn parameter(quantity: Quantity, estimate: f64, error: f64) -> NamedParameter {
    (quantity.into(), with_error(estimate, error, quantity.unit()))
}

/// An estimate with a symmetric interval of 1.96 standard errors.
pub fn with_error(estimate: f64, error: f64, unit: Unit) -> Parameter {
    let half = 1.96 * error;
    Parameter { estimate, unit, ci95: [estimate - half, estimate + half] }
}

/// The number of a sensor as a parameter: exact.
pub fn sensor_number(sensor: usize) -> NamedParameter {
    let number = sensor as f64;
    (Quantity::Sensor.into(), Parameter { estimate: number, unit: Unit::Number, ci95: [number; 2] })
}
