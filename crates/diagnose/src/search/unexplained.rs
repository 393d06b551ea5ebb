//! What depends on rows or azimuths and has no name in the catalogue.

use super::Found;
use crate::channels::groups::{GroupSums, Grouping, PartedFrame, group_of, place_of};
use crate::diagnosis::{Curve, CurvePoint, Parameter, Status};
use crate::inference::grouped::{self, GroupFit};
use crate::pairing::Ray;
use std::collections::BTreeMap;

/// What a channel says of such a finding.
pub(super) struct Unnamed {
    pub(super) channel: &'static str,
    pub(super) confidence: f64,
    pub(super) parameters: Vec<(String, Parameter)>,
    pub(super) says: String,
    pub(super) y: &'static str,
}

/// What directions are grouped by, as findings call it.
pub(super) fn word(grouping: Grouping) -> &'static str {
    if grouping == Grouping::Row { "row" } else { "azimuth" }
}

/// Mean of a value over the rays of each group.
pub(super) fn mean_by_group<'a>(
    rays: impl Iterator<Item = &'a Ray>,
    grouping: Grouping,
    value: impl Fn(&Ray) -> Option<f64>,
) -> BTreeMap<u32, f64> {
    let mut sums = BTreeMap::<u32, [f64; 2]>::new();
    for ray in rays {
        if let (Some(v), Some(g)) = (value(ray), group_of(ray, grouping)) {
            let sum = sums.entry(g as u32).or_default();
            (sum[0], sum[1]) = (sum[0] + v, sum[1] + 1.0);
        }
    }
    sums.into_iter().map(|(g, s)| (g, s[0] / s[1])).collect()
}

impl Unnamed {
    /// The finding. `all` are the sums over the estimating frames, `hold_out` the frames held out; `shown` turns a group's number, offset and standard
    /// error into what is shown: the measured value and its error, where the simulated one is 1.
    pub(super) fn found<'a>(
        self,
        all: &BTreeMap<u32, GroupSums>,
        how: GroupFit,
        grouping: Grouping,
        hold_out: impl Iterator<Item = &'a PartedFrame>,
        shown: impl Fn(u32, f64, f64) -> [f64; 2],
    ) -> Found {
        let offsets = grouped::offsets(all, how);
        let points = offsets.iter().map(|(k, offset)| {
            let (sensor, place) = place_of(*k as usize, grouping);
            let place = if grouping == Grouping::Row { place } else { place.to_degrees() };
            let [measured, error] = shown(*k, *offset, 1.0 / (all[k].gram[0] + how.precision).sqrt());
            CurvePoint { x: place + 1000.0 * sensor as f64, measured, before: 1.0, after: measured, error }
        });
        let gain = |frame: &PartedFrame| frame.iter().map(|part| grouped::gain(part, how.column, &offsets)).sum();
        Found {
            status: Status::Unexplained,
            causes: vec![],
            family: "unknown",
            parameters: self.parameters,
            confidence: self.confidence,
            channel: self.channel,
            covariate: word(grouping).into(),
            held_out_gains: hold_out.map(gain).collect(),
            says: self.says,
            separate_by: None,
            curve: Curve {
                x: format!("{} (1000 a sensor)", word(grouping)),
                y: self.y.into(),
                points: points.collect(),
            },
        }
    }
}
