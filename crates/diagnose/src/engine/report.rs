//! Puts the results of all channels together: the diagnosis.

use crate::catalogue::Channel;
use crate::diagnosis::{Diagnosis, Finding, FrameRoles, Gain, Predicted, SCHEMA, Status, Verdict};
use crate::inference::roles::Role;
use crate::pairing::FramePair;
use crate::search::{ChannelResult, Context, Found, REPETITIONS, mean_interval};
use geometry::Box3;
use statistics::{blocks_of, draw_blocks, interval_nearest};
use std::collections::BTreeMap;

/// Name of the metric of gains.
pub const METRIC: &str = "nats_per_ray";

/// A diagnosis of notes alone.
pub(crate) fn refused(notes: Vec<String>) -> Diagnosis {
    Diagnosis {
        schema: SCHEMA.into(),
        build: data::build_id().into(),
        verdict: Verdict::NotScenarioIdentical,
        frames: FrameRoles::default(),
        findings: vec![],
        minimum_detectable: Default::default(),
        gain: Gain { metric: METRIC.into(), ..Gain::default() },
        detectors: Vec::new(),
        not_identifiable: Vec::new(),
        considered: vec![],
        notes,
    }
}

/// The diagnosis of all results.
pub(crate) fn report(context: &Context, results: Vec<ChannelResult>, notes: Vec<String>) -> Diagnosis {
    let hold_out = context.of(Role::HoldOut);
    let mut report = Report {
        blocks: context.blocks(&hold_out),
        returns: context.returns(&hold_out).max(1.0),
        findings: Vec::new(),
        distance: vec![[0.0; 3]; hold_out.len()],
        channels: BTreeMap::new(),
    };
    let mut considered = Vec::new();
    let mut minimum_detectable = BTreeMap::new();
    for result in results {
        report.add_distance(result.channel, &result.distance);
        considered.extend(result.considered);
        minimum_detectable.extend(result.minimum);
        result.found.into_iter().for_each(|found| report.add(found));
    }
    let Report { blocks, returns, mut findings, distance, channels } = report;
    findings.sort_by(|a, b| b.gain.nats_per_ray.total_cmp(&a.gain.nats_per_ray));
    let ids = |role| context.of(role).into_iter().map(|i| context.frames[i].id.clone()).collect();
    Diagnosis {
        schema: SCHEMA.into(),
        build: data::build_id().into(),
        verdict: Verdict::of(&findings),
        frames: FrameRoles { select: ids(Role::Select), estimate: ids(Role::Estimate), hold_out: ids(Role::HoldOut) },
        gain: Gain {
            metric: METRIC.into(),
            predicted: (!findings.is_empty()).then(|| Predicted { channels, ..predicted(&distance, &blocks, returns) }),
            ..Gain::default()
        },
        findings,
        minimum_detectable,
        detectors: Vec::new(),
        not_identifiable: Vec::new(),
        considered,
        notes,
    }
}

/// Findings and distances so far.
struct Report {
    /// Blocks of the held-out frames.
    blocks: Vec<usize>,
    /// Simulated returns of the held-out frames.
    returns: f64,
    findings: Vec<Finding>,
    /// Of every held-out frame the distance, the gain of the findings, and the gain of unconstrained lookup tables,
    /// nats.
    distance: Vec<[f64; 3]>,
    /// Distance before, after and at the floor, nats a return.
    channels: BTreeMap<Channel, [f64; 3]>,
}

impl Report {
    /// Adds the distances of a channel.
    fn add_distance(&mut self, channel: Channel, distance: &[[f64; 3]]) {
        let of_channel = self.channels.entry(channel).or_default();
        for [before, gained, best] in distance {
            let left = [*before, before - gained, before - gained.max(*best)];
            (0..3).for_each(|k| of_channel[k] += left[k] / self.returns);
        }
        for (sum, d) in self.distance.iter_mut().zip(distance) {
            (0..3).for_each(|k| sum[k] += d[k]);
        }
    }

    /// Adds a finding. A cause that is named in two channels is one finding; twice in one channel, as a loss on each of
    /// two kinds of surface, it is two.
    fn add(&mut self, found: Found) {
        let cause = found.causes.first().copied().filter(|_| found.status == Status::Named);
        let gain = mean_interval(&found.held_out_gains, &self.blocks, self.returns);
        let same = |f: &Finding| cause.is_some() && f.cause == cause && f.channel != found.channel;
        if let Some(same) = self.findings.iter_mut().find(|f| same(f)) {
            same.gain.nats_per_ray += gain.nats_per_ray;
            (0..2).for_each(|k| same.gain.ci95[k] += gain.ci95[k]);
            for (id, p) in found.parameters {
                same.parameters.entry(id).or_insert(p);
            }
            return;
        }
        self.findings.push(Finding {
            status: found.status,
            cause,
            candidates: (found.status == Status::Ambiguous).then(|| found.causes.clone()),
            family: found.family(),
            parameters: found.parameters.into_iter().collect(),
            confidence: found.confidence,
            channel: found.channel,
            covariate: found.covariate,
            gain,
            predicted: None,
            reached: None,
            says: found.says,
            separate_by: found.separate_by,
            curve: found.curve,
            effects: found.effects,
        });
    }
}

/// Distance over all held-out frames as the fits predict it, with the interval of the share that is closed. `sums`
/// holds of every frame its distance, the gain of the findings, and the gain of unconstrained lookup tables.
fn predicted(sums: &[[f64; 3]], blocks: &[usize], returns: f64) -> Predicted {
    let total = |which: &[usize]| {
        which.iter().fold([0.0; 3], |s, &i| [s[0] + sums[i][0], s[1] + sums[i][1], s[2] + sums[i][2]])
    };
    let closed = |[_, gained, table]: [f64; 3]| (gained.max(table) > 0.0).then(|| gained / gained.max(table));
    let all = total(&(0..sums.len()).collect::<Vec<_>>());
    let members = blocks_of(blocks);
    let mut rng = data::stream(0, "diagnose closed", 0, 0);
    let drawn: Vec<f64> = (0..REPETITIONS).filter_map(|_| closed(total(&draw_blocks(&members, &mut rng)))).collect();
    let least = all[1].max(all[2]);
    let before = all[0].max(least);
    Predicted {
        before: before / returns,
        after: (before - all[1]) / returns,
        floor: (before - least) / returns,
        closed: closed(all),
        ci95: closed(all).and_then(|_| interval_nearest(drawn)),
        channels: BTreeMap::new(),
    }
}

/// Measured boxes after all corrections, as [`super::Outcome::corrected`]; empty where there is none.
pub(super) fn corrected(context: &Context, results: &[ChannelResult]) -> Vec<(String, [Vec<Box3>; 3])> {
    let repairs: Vec<_> = results.iter().flat_map(|r| &r.repairs).collect();
    if repairs.is_empty() {
        return vec![];
    }
    let boxes = |(f, frame): (usize, &FramePair)| {
        let version = |version: usize| {
            let moved = frame.objects.iter().enumerate().filter_map(|(k, o)| {
                let mut b = o.measured?;
                for r in repairs.iter().filter(|r| (r.frame, r.object) == (f, k)) {
                    (0..3).for_each(|axis| b.center[axis] += r.shifts_m[version][axis]);
                }
                Some(b)
            });
            moved.collect()
        };
        (frame.id.clone(), [0, 1, 2].map(version))
    };
    context.frames.iter().enumerate().map(boxes).collect()
}
