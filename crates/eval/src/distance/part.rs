//! Subsets of the points of a cloud.

use super::Point;
use crate::RangeSection;
use data::Frame;
use geometry::{Box3, points_in_boxes};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::fmt;

/// The subset of points that is compared.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Part {
    /// All points within the maximum range.
    Whole,
    /// Points in the labelled boxes of their frame.
    Targets,
    /// Points in this range section (ground-plane distance).
    Section(RangeSection),
}

impl fmt::Display for Part {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Part::Whole => f.write_str("whole cloud"),
            Part::Targets => f.write_str("targets"),
            Part::Section(section) => section.fmt(f),
        }
    }
}

/// Points of a part, in cloud order.
pub(super) fn select(frame: &Frame, part: Part, max_range_m: f64) -> Vec<Point> {
    let cloud = &frame.cloud;
    let range_m = |p: &Point| f64::from(p[0]).hypot(f64::from(p[1]));
    // A non-finite position has no range. It is kept here so that it is reported as an error later.
    let whole = |p: &Point| !(range_m(p) > max_range_m);
    match part {
        Part::Whole => (0..cloud.len()).map(|i| cloud.xyz(i)).filter(whole).collect(),
        Part::Section(section) => {
            (0..cloud.len()).map(|i| cloud.xyz(i)).filter(|p| section.contains(range_m(p))).collect()
        }
        Part::Targets => {
            let boxes: Vec<Box3> = frame.objects.iter().map(|object| object.bbox).collect();
            let inside = points_in_boxes(&cloud.values, cloud.channels, &boxes, 0.0);
            let inside: BTreeSet<u32> = inside.into_iter().flatten().collect();
            inside.into_iter().map(|i| cloud.xyz(i as usize)).filter(whole).collect()
        }
    }
}
