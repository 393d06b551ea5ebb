//! Findings that depend on rows or azimuths and have no cause in the catalogue.

use super::{Found, NamedParameter, confidence, trimmed};
use crate::catalogue::{Cause, Channel};
use crate::channels::groups::{Group, GroupSums, Grouping, PartedFrame, group_of, total};
use crate::curve::{Curve, CurvePoint};
use crate::diagnosis::Status;
use crate::inference::choice::{Demands, Trial};
use crate::inference::grouped::{self, GroupFit};
use crate::pairing::Ray;
use std::collections::BTreeMap;

/// What a channel says of such a finding.
pub(super) struct Unexplained {
    pub(super) channel: Channel,
    pub(super) grouping: Grouping,
    pub(super) confidence: f64,
    pub(super) parameters: Vec<NamedParameter>,
    pub(super) says: String,
    /// Name and unit of what the plot shows.
    pub(super) y: &'static str,
}

/// Mean of a value over the rays of each group.
pub(super) fn mean_by_group<'a>(
    rays: impl Iterator<Item = &'a Ray>,
    grouping: Grouping,
    value: impl Fn(&Ray) -> Option<f64>,
) -> BTreeMap<Group, f64> {
    let mut sums = BTreeMap::<Group, [f64; 2]>::new();
    for ray in rays {
        if let (Some(v), Some(g)) = (value(ray), group_of(ray, grouping)) {
            let sum = sums.entry(g).or_default();
            (sum[0], sum[1]) = (sum[0] + v, sum[1] + 1.0);
        }
    }
    sums.into_iter().map(|(g, s)| (g, s[0] / s[1])).collect()
}

/// Trials of tables by row and by azimuth: no cause of the catalogue. They are numbered from `first` on; `floors` are
/// the smallest spreads that are reported by row and by azimuth, and `groups` are the sums of all frames by grouping.
pub(super) fn direction_trials(
    select: &[usize],
    blocks: &[usize],
    first: usize,
    how: GroupFit,
    floors: [f64; 2],
    groups: impl Fn(Grouping) -> Vec<PartedFrame>,
) -> Vec<Trial> {
    let trial = |grouping: Grouping| {
        let groups = groups(grouping);
        let (spread, _) = grouped::spread(&total(select.iter().flat_map(|&i| &groups[i])), how, trimmed(grouping));
        Trial {
            candidate: first + grouping as usize,
            cause: Cause::Unexplained,
            parameters: 12,
            gains: grouped::cross_part_gains(&groups, select, blocks, how, false),
            expected: vec![],
            above_floor: spread > floors[grouping as usize],
        }
    };
    [Grouping::Row, Grouping::Azimuth].map(trial).into()
}

/// Grouping and confidence of the chosen one of these trials.
pub(super) fn table_by_direction(
    trials: &[Trial],
    chosen: usize,
    first: usize,
    blocks: &[usize],
    demands: &Demands,
) -> (Grouping, f64) {
    let grouping = if trials[chosen].candidate == first { Grouping::Row } else { Grouping::Azimuth };
    (grouping, confidence(trials, blocks, Cause::Unexplained, demands))
}

impl Unexplained {
    /// The finding. `all` holds the sums over the estimating frames, `hold_out` the held-out frames. `shown` maps a
    /// group, its offset and its standard error to the measured value of the plot and its error, in units of the
    /// simulated value.
    pub(super) fn found<'a>(
        self,
        all: &BTreeMap<Group, GroupSums>,
        how: GroupFit,
        hold_out: impl Iterator<Item = &'a PartedFrame>,
        shown: impl Fn(Group, f64, f64) -> [f64; 2],
    ) -> Found {
        let offsets = grouped::offsets(all, how);
        let points = offsets.iter().map(|(group, offset)| {
            let place = group.place(self.grouping);
            let x = if self.grouping == Grouping::Azimuth { place.to_degrees() } else { place };
            let [measured, error] = shown(*group, *offset, 1.0 / (all[group].gram[0] + how.precision).sqrt());
            CurvePoint { sensor: usize::from(group.sensor), x, measured, before: 1.0, after: measured, error }
        });
        let gain = |frame: &PartedFrame| frame.iter().map(|part| grouped::gain(part, how.column, &offsets)).sum();
        Found {
            effects: Vec::new(),
            status: Status::Unexplained,
            causes: vec![],
            parameters: self.parameters,
            confidence: self.confidence,
            channel: self.channel,
            covariate: self.grouping.into(),
            held_out_gains: hold_out.map(gain).collect(),
            says: self.says,
            separate_by: None,
            curve: Curve {
                x: self.grouping.name().into(),
                y: self.y.into(),
                by_sensor: true,
                points: points.collect(),
            },
        }
    }
}
