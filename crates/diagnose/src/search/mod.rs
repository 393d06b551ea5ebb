//! What each channel finds: candidates are weighed on the selecting frames, fitted on the estimating ones, measured on those held out.

pub mod geometry;
pub mod hits;
pub mod labels;
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
use crate::rig::SensorRig;
use rand::RngExt;

/// What all searches share.
pub struct Context<'a> {
    /// Sensors.
    pub rig: &'a SensorRig,
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

/// Share of a pose's gain below which a finding of another channel is what moving the scene back leaves.
const LEFT_BY_A_POSE: f64 = 0.005;

/// Share of the gain of offsets of rows below which a law of noise is what mending them leaves.
const LEFT_BY_ROWS: f64 = 0.15;

/// Share of the gain of losses below which a slight bias of range is a matter of which returns are left.
const LEFT_BY_LOSSES: f64 = 0.04;

/// Whether a finding is a bias of range of less than 4 cm at 30 m.
fn slight_bias(f: &Found) -> bool {
    let value = |name: &str| f.parameters.iter().find(|(n, _)| n == name).map_or(0.0, |(_, p)| p.estimate);
    f.causes == ["range_bias"] && (value("offset_m") + 30.0 * value("scale")).abs() < 0.04
}

/// Nats a return below which a law of noise beside surfaces that stand elsewhere, slide or mix is what these leave.
const LEFT_OF_NOISE: f64 = 0.03;

/// Times the gain of rows that aim elsewhere below which a law of noise is what is left of the jumps between rows on the ground.
const LEFT_BY_AIMS: f64 = 2.5;

/// Share of the gain of rows that aim elsewhere below which the pose of a sensor is what their mean leaves.
const LEFT_BY_ROWS_OF_A_POSE: f64 = 0.25;

/// Share of what the own car hides below which a sensor's pose is a matter of which surfaces it still sees.
const LEFT_BY_OWN_CAR: f64 = 0.05;

/// Share of the gain of missing things below which mixed ranges are their returns.
const LEFT_BY_THINGS: f64 = 0.05;

/// Share of the gain of rows that aim elsewhere below which mixed ranges are returns of rows that see past edges.
const LEFT_BY_AIMS_OF_MIXED: f64 = 0.1;

/// Share of the gain of jitter below which mixed ranges are returns that it carried across edges.
const LEFT_BY_JITTER: f64 = 0.001;

/// Share of the gain of a sensor's pose below which things that only the simulation has are what this sensor looks over.
const LEFT_BY_A_POSE_OF_THINGS: f64 = 0.1;

/// Nats a return below which a law of noise beside surfaces that are off in a way without a name is a part of that, and share of what this
/// gains below which poses and shifts of objects are.
const LEFT_BY_THE_UNNAMED: [f64; 2] = [0.1, 0.25];

/// Standard errors by which a sensor's pose must be off in one number: its six take up what is wrong with the few surfaces that it alone sees.
const SURE_OF_A_SENSOR: f64 = 4.5;

/// Whether a finding is more than chance on the frames that say how large it is: intervals of some number exclude 0, where it has any.
fn speaks(f: &Found) -> bool {
    let of_sensor = f.causes == ["sensor_extrinsics"];
    let mut sizes = f.parameters.iter().map(|(_, p)| p).filter(|p| p.unit != "number").peekable();
    let sure = |p: &Parameter| p.estimate.abs() > SURE_OF_A_SENSOR / 1.96 * (p.ci95[1] - p.ci95[0]) / 2.0;
    sizes.peek().is_none() || sizes.any(|p| p.ci95[0] * p.ci95[1] > 0.0 && (!of_sensor || sure(p)))
}

/// Whether things are said to be in the simulation alone.
fn things_too_many(f: &Found) -> bool {
    f.causes == ["missing_object"] && f.parameters.iter().any(|(_, p)| p.estimate < 0.0)
}

/// Drops what a pose that was moved back, rows that were mended, and a scene that slid leave in channels that look at single returns. `returns` are those of
/// the frames that were held out.
pub fn without_leftovers(results: &mut [ChannelResult], returns: f64) {
    let gain = |f: &Found| f.held_out_gains.iter().sum::<f64>();
    let most = |results: &[ChannelResult], of: &dyn Fn(&Found) -> bool| {
        results.iter().flat_map(|r| &r.found).filter(|f| of(f)).map(gain).fold(0.0, f64::max)
    };
    let spoke: Vec<bool> = results.iter().map(|r| !r.found.is_empty()).collect();
    results.iter_mut().for_each(|r| r.found.retain(speaks));
    let rows = most(results, &|f| f.causes.first().is_some_and(|c| c.starts_with("beam_")));
    let aims = most(results, &|f| f.causes == ["beam_elevation_offset"]);
    let things = most(results, &|f| f.causes == ["missing_object"]);
    let jitter = most(results, &|f| f.causes == ["angular_jitter"]);
    let losses = most(results, &|f| f.channel == "hits");
    let hidden = most(results, &|f| f.causes == ["ego_occlusion"]);
    let slides = results.iter().flat_map(|r| &r.found).any(|f| f.channel == "slide");
    for result in results.iter_mut() {
        let least = (LEFT_BY_OWN_CAR * hidden).max(LEFT_BY_ROWS_OF_A_POSE * aims);
        result.found.retain(|f| f.causes != ["sensor_extrinsics"] || gain(f) >= least);
        // Where far returns are lost, those that come back are the nearer ones.
        result.found.retain(|f| !(slight_bias(f) && gain(f) < LEFT_BY_LOSSES * losses));
        result.found.retain(|f| f.channel != "roughness" || gain(f) >= (LEFT_BY_ROWS * rows).max(LEFT_BY_AIMS * aims));
        // Things that stand before edges lie between what these show.
        let least = (LEFT_BY_THINGS * things).max(LEFT_BY_JITTER * jitter).max(LEFT_BY_AIMS_OF_MIXED * aims);
        result.found.retain(|f| f.causes != ["mixed_pixels"] || gain(f) >= least);
        // Things that move by themselves slide otherwise than what stands.
        result.found.retain(|f| !(slides && f.causes == ["missing_object"]));
    }
    let posed = |f: &Found| f.causes.iter().any(|c| matches!(c.as_str(), "pitch_roll" | "sensor_extrinsics"));
    let pose = most(results, &|f| f.channel == "residuals" && posed(f));
    for result in results.iter_mut() {
        result
            .found
            .retain(|f| !matches!(f.channel, "hits" | "roughness" | "returns") || gain(f) >= LEFT_BY_A_POSE * pose);
        result.found.retain(|f| !things_too_many(f) || gain(f) >= LEFT_BY_A_POSE_OF_THINGS * pose);
    }
    let unnamed = |f: &Found| f.channel == "residuals" && f.status == Status::Unexplained;
    let without_a_name = most(results, &unnamed);
    if without_a_name > 0.0 {
        let left = |f: &Found| match f.channel {
            "roughness" => gain(f) < LEFT_BY_THE_UNNAMED[0] * returns,
            "residuals" | "objects" => gain(f) < LEFT_BY_THE_UNNAMED[1] * without_a_name,
            _ => false,
        };
        results.iter_mut().for_each(|r| r.found.retain(|f| !left(f)));
    }
    let disturbs = |f: &Found| matches!(f.channel, "residuals" | "slide") || f.causes == ["mixed_pixels"];
    if results.iter().flat_map(|r| &r.found).any(disturbs) {
        let rough = |f: &Found| f.channel == "roughness" && gain(f) < LEFT_OF_NOISE * returns;
        results.iter_mut().for_each(|r| r.found.retain(|f| !rough(f)));
    }
    // What mending leaves explains nothing, and no sensor model could close it.
    for (result, spoke) in results.iter_mut().zip(spoke) {
        if spoke && result.found.is_empty() {
            result.distance.iter_mut().for_each(|d| (d[1], d[2]) = (0.0, 0.0));
        }
    }
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

#[cfg(test)]
mod tests {
    use super::*;

    fn found(cause: &str, channel: &'static str, gain: f64, parameters: Vec<(String, Parameter)>) -> Found {
        Found {
            status: if cause.is_empty() { Status::Unexplained } else { Status::Named },
            causes: if cause.is_empty() { vec![] } else { vec![cause.into()] },
            family: "",
            parameters,
            confidence: 1.0,
            channel,
            covariate: String::new(),
            held_out_gains: vec![gain; 10],
            says: String::new(),
            separate_by: None,
            curve: Curve { x: String::new(), y: String::new(), points: vec![] },
        }
    }

    /// What is left of findings beside the first, on 1,000 returns held out.
    fn left(all: Vec<Found>) -> Vec<String> {
        let mut results: Vec<ChannelResult> =
            all.into_iter().map(|f| ChannelResult { found: vec![f], ..ChannelResult::default() }).collect();
        without_leftovers(&mut results, 1000.0);
        results.into_iter().skip(1).flat_map(|r| r.found).flat_map(|f| f.causes).collect()
    }

    #[test]
    fn what_others_leave_is_dropped_and_what_stands_for_itself_is_kept() {
        let number = |name: &str, value: f64| vec![parameter(name, value, 0.1 * value.abs(), "1")];
        let cases = [
            // (first, its gain), (second, its channel, its size, gain that is left over, gain that stands for itself)
            (("beam_elevation_offset", "residuals", 3.0), ("mixed_pixels", "returns", 0.003, 0.2, 0.4)),
            (("sensor_extrinsics", "residuals", 40.0), ("missing_object", "returns", -0.005, 3.0, 5.0)),
            (("sensor_extrinsics", "residuals", 40.0), ("missing_object", "returns", 0.005, 0.1, 3.0)),
            (("", "residuals", 1.0), ("range_noise", "roughness", 0.02, 9.0, 11.0)),
        ];
        for ((first, channel, gain), (second, of, size, left_over, itself)) in cases {
            let beside =
                |g| left(vec![found(first, channel, gain, number("a", 1.0)), found(second, of, g, number("b", size))]);
            assert!(beside(left_over).is_empty(), "{second} {left_over}");
            assert_eq!(beside(itself), [second]);
        }
    }

    #[test]
    fn an_interval_about_nothing_is_no_finding() {
        let sensor = || ("sensor".to_owned(), Parameter { estimate: 2.0, unit: "number".into(), ci95: [2.0, 2.0] });
        let about =
            |value: f64| found("time_offset", "objects", 1.0, vec![sensor(), parameter("offset_s", value, 0.003, "s")]);
        let first = || found("range_bias", "residuals", 1.0, vec![]);
        assert!(left(vec![first(), about(-0.0006)]).is_empty());
        assert_eq!(left(vec![first(), about(-0.02)]), ["time_offset"]);
        assert_eq!(left(vec![first(), found("missing_object", "returns", 1.0, vec![])]), ["missing_object"]);
    }
}
