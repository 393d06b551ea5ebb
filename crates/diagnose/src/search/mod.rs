//! What each channel finds: candidates are weighed on the selecting frames, fitted on the estimating ones, measured on those held out.

pub mod geometry;
pub mod hits;
pub mod labels;
pub mod leftovers;
pub mod mask;
pub mod noise;
mod patch;
pub mod quantisation;
pub mod returns;
pub mod shutter;
mod unnamed;

use crate::channels::groups::Grouping;
use crate::channels::motion::OwnMotion;
use crate::diagnosis::{Considered, Curve, FindingGain, Minimum, Parameter, Status};
use crate::inference::choice::{Choice, Demands, Trial, choose, total_and_z};
use crate::inference::roles::Role;
use crate::pairing::FramePair;
use rand::RngExt;
use sensor::Rig;

/// What all searches share.
#[derive(Clone)]
pub struct Context<'a> {
    /// Sensors.
    pub rig: &'a Rig,
    /// Frames in order.
    pub frames: &'a [FramePair],
    /// Role and block of each.
    pub roles: Vec<(Role, usize)>,
    /// Times of the frames, s, where their ids tell.
    pub times: Option<Vec<f64>>,
    /// How the own car moves at each frame, where the scenes tell.
    pub motion: Option<Vec<Option<OwnMotion>>>,
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

    /// Simulated returns of these frames.
    pub fn returns(&self, frames: &[usize]) -> f64 {
        frames.iter().map(|&i| self.frames[i].simulated.len() as f64).sum()
    }
}

/// A difference before it is put into words.
#[derive(Clone, Debug)]
pub struct Found {
    /// Status.
    pub status: Status,
    /// The cause, or the candidates with the one whose parameters stand here first.
    pub causes: Vec<String>,
    /// Family of causes.
    pub family: &'static str,
    /// Parameters by name.
    pub parameters: Vec<(String, Parameter)>,
    /// Share of repetitions with the same choice.
    pub confidence: f64,
    /// Channel.
    pub channel: &'static str,
    /// Covariate.
    pub covariate: String,
    /// Gain on held-out frames, nats, frame by frame in their order.
    pub held_out_gains: Vec<f64>,
    /// In a sentence.
    pub says: String,
    /// What would tell candidates apart.
    pub separate_by: Option<String>,
    /// Picture.
    pub curve: Curve,
}

/// What a channel's search hands back.
#[derive(Clone, Debug, Default)]
pub struct ChannelResult {
    /// Channel in which it searched; the engine, which runs the searches, writes it down.
    pub channel: &'static str,
    /// Findings.
    pub found: Vec<Found>,
    /// Candidates and what became of them.
    pub considered: Vec<Considered>,
    /// Smallest effects that would have been seen.
    pub minimum: Vec<(String, Minimum)>,
    /// On held-out frames, frame by frame, nats: distance of the simulation, what the findings gain, and what tables without any form, fitted
    /// on the same frames as the findings, would gain.
    pub distance: Vec<[f64; 3]>,
    /// How measured labels are to be moved.
    pub repairs: Vec<Repair>,
}

/// How a measured label is to be moved.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Repair {
    /// Number of the frame.
    pub frame: usize,
    /// Number of the object in the frame.
    pub object: usize,
    /// By how much, in the cloud's frame, m.
    pub shift_m: [f64; 3],
}

/// Mean gain over its standard error that a finding must have: no null of the blind set came near.
pub const Z_STAR: f64 = 3.2;

/// The demands of a first step.
pub fn first_demands() -> Demands {
    Demands { z: Z_STAR, nats: 8.0, slack: 0.02, told: 0.02 }
}

/// Share of rows whose offsets do not count in their spread: a row may follow the upper edge of a wall, which every shift of the wall
/// moves.
pub fn trimmed(grouping: Grouping) -> f64 {
    if grouping == Grouping::Row { 0.12 } else { 0.0 }
}

/// Objects that are swept by more than that over a scan leave nothing else to be judged by, m.
const SWEPT_M: f64 = 0.8;

/// Sets aside what a scan that takes its time makes in the other channels: whole scenes shear, and surfaces, silhouettes and directions do not
/// fit any more. Says so.
pub fn set_aside(results: &mut [ChannelResult]) -> Option<String> {
    let of_objects = |f: &Found| f.channel == "objects" && f.causes == ["rolling_shutter"];
    let found = results.iter().flat_map(|r| &r.found).find(|f| of_objects(f))?;
    let scan_s = found.parameters.iter().find(|(name, _)| name == "scan_s")?.1.estimate.abs();
    let fastest = found.curve.points.iter().map(|p| p.x.abs()).fold(0.0, f64::max);
    // Cars are met at tens of m/s over the ground, whatever the sensor sees of them.
    if scan_s * fastest.max(20.0) < SWEPT_M {
        return None;
    }
    let mut set_aside = Vec::new();
    for result in results.iter_mut() {
        let sheared = |f: &Found| matches!(f.channel, "residuals" | "hits" | "roughness" | "returns");
        set_aside.extend(
            result
                .found
                .iter()
                .filter(|f| sheared(f))
                .map(|f| f.causes.first().map_or("unexplained", String::as_str).to_owned()),
        );
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

/// A draw of blocks with replacement; `members[b]` lists what belongs to block b.
pub fn draw_blocks(members: &[Vec<usize>], rng: &mut data::Stream) -> Vec<usize> {
    let mut drawn = Vec::new();
    for _ in 0..members.len() {
        drawn.extend(&members[rng.random_range(0..members.len())]);
    }
    drawn
}

/// Places of equal blocks together.
pub fn by_block(blocks: &[usize]) -> Vec<Vec<usize>> {
    let mut members: Vec<Vec<usize>> = Vec::new();
    let mut last = None;
    for (i, b) in blocks.iter().enumerate() {
        if last != Some(b) {
            members.push(Vec::new());
            last = Some(b);
        }
        if let Some(block) = members.last_mut() {
            block.push(i);
        }
    }
    members
}

/// Share of block bootstraps of the gains that choose a trial of the same name.
pub fn confidence(trials: &[Trial], blocks: &[usize], chosen: &str, demands: &Demands) -> f64 {
    let members = by_block(blocks);
    let mut rng = data::stream(0, "diagnose confidence", trials.len() as u64, 0);
    let repetitions = 200;
    let same = (0..repetitions)
        .filter(|_| {
            let drawn = draw_blocks(&members, &mut rng);
            let again: Vec<Trial> = trials
                .iter()
                .map(|t| Trial { gains: drawn.iter().map(|&i| t.gains[i]).collect(), ..t.clone() })
                .collect();
            let easier = Demands { z: 0.0, nats: 0.0, ..*demands };
            choose(&again, &easier).is_some_and(|c| again[c.chosen].name == chosen)
        })
        .count();
    same as f64 / f64::from(repetitions)
}

/// Below this share of bootstraps the runner-up is told as well.
const SURE: f64 = 0.8;

/// What explains as much as the chosen one, and the confidence: where many bootstraps choose another name, that one as well.
pub fn unless_unsure(
    mut equals: Vec<String>,
    trials: &[Trial],
    blocks: &[usize],
    chosen: &str,
    demands: &Demands,
) -> (Vec<String>, f64) {
    let confidence = confidence(trials, blocks, chosen, demands);
    if equals.is_empty() && confidence < SURE {
        let others = trials.iter().filter(|t| t.name != chosen && t.above_floor);
        let rival = others.max_by(|a, b| total_and_z(&a.gains).0.total_cmp(&total_and_z(&b.gains).0));
        equals.extend(rival.map(|t| t.name.clone()));
    }
    (equals, confidence)
}

/// Interval of the mean of per-frame values by a bootstrap over blocks, divided by `per`.
pub fn mean_interval(values: &[f64], blocks: &[usize], per: f64) -> FindingGain {
    let members = by_block(blocks);
    let mut rng = data::stream(0, "diagnose interval", values.len() as u64, 0);
    let mut sums: Vec<f64> = (0..REPETITIONS)
        .map(|_| {
            let drawn = draw_blocks(&members, &mut rng);
            drawn.iter().map(|&i| values[i]).sum::<f64>() / drawn.len().max(1) as f64 * values.len() as f64 / per
        })
        .collect();
    sums.sort_by(f64::total_cmp);
    let at = |q: f64| sums.get(((sums.len() as f64 - 1.0) * q).round() as usize).copied().unwrap_or(0.0);
    FindingGain { nats_per_ray: values.iter().sum::<f64>() / per, ci95: [at(0.025), at(0.975)] }
}

/// Writes down what became of every trial.
pub fn record(
    trials: &[Trial],
    choice: Option<&Choice>,
    channel: &str,
    rays: f64,
    demands: &Demands,
) -> Vec<Considered> {
    let line = |(i, t): (usize, &Trial)| {
        let (total, z) = total_and_z(&t.gains);
        let outcome = match choice {
            Some(c) if c.chosen == i => "chosen".to_owned(),
            Some(c) if c.equals.contains(&i) => "explains as much, or nearly so, as far as these frames tell".into(),
            _ if total <= demands.nats || z <= demands.z => "no gain on frames that it was not fitted on".into(),
            _ if !t.above_floor => "too small to speak of".into(),
            Some(c) => {
                let (best, _) = total_and_z(&trials[c.chosen].gains);
                if total >= best * 0.98 { "gains no more, with more parameters".into() } else { "gains less".into() }
            }
            None => "not chosen".into(),
        };
        Considered { cause: t.name.clone(), channel: channel.into(), nats_per_ray: total / rays, z, outcome }
    };
    trials.iter().enumerate().map(line).collect()
}

/// A parameter with a symmetric interval of 1.96 standard errors.
pub fn parameter(name: &str, estimate: f64, error: f64, unit: &str) -> (String, Parameter) {
    let half = 1.96 * error;
    (name.into(), Parameter { estimate, unit: unit.into(), ci95: [estimate - half, estimate + half] })
}
