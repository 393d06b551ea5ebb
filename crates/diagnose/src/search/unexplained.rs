//! Findings that depend on rows or azimuths and have no cause in the catalogue.

use super::{Found, NamedParameter};
use crate::catalogue::Channel;
use crate::channels::groups::{Group, GroupSums, Grouping, PartedFrame, group_of};
use crate::curve::{Curve, CurvePoint};
use crate::diagnosis::Status;
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
            let x = if self.grouping == Grouping::Row { place } else { place.to_degrees() };
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
