//! Checks whether the data fit the detector: classes, range, anchors.

use super::report::{Findings, Spread, at_most};
use super::statistics::at;
use super::survey::{FrameFacts, ObjectFacts};
use super::{AnchorFacts, DetectorFacts};
use crate::Dataset;

/// Smallest useful IoU, seen from above, of an anchor and a box with the same centre and yaw. Below, anchors are rarely
/// matched to boxes.
const ANCHOR_OVERLAP: f64 = 0.5;

pub(super) fn compare(dataset: &Dataset, detector: &DetectorFacts, frames: &[FrameFacts], findings: &mut Findings) {
    let listed = &dataset.config.classes;
    let unknown: Vec<_> = detector.classes.iter().filter(|class| !listed.contains(class)).cloned().collect();
    if !unknown.is_empty() {
        let message = format!(
            "the detector's {} is not among the data set's classes ({})",
            unknown.join(", "),
            listed.join(", ")
        );
        findings.problem("classes", message, []);
    }
    let objects: Vec<(&str, &ObjectFacts)> = frames
        .iter()
        .flat_map(|f| f.objects.iter().map(|o| (f.id.as_str(), o)))
        .filter(|(_, o)| detector.classes.contains(&o.class))
        .collect();
    let inside =
        |o: &ObjectFacts| (0..3).all(|i| (detector.range[i]..=detector.range[i + 3]).contains(&o.bbox.center[i]));
    let outside: Vec<_> = objects.iter().filter(|(_, o)| !inside(o)).map(|(id, o)| at(id, o)).collect();
    let message = format!(
        "{} of {} boxes have their centre outside of the detector's range {:?} m and are not used in training: {}",
        outside.len(),
        objects.len(),
        detector.range,
        at_most(5, &outside, ", ")
    );
    findings.by_share("boxes outside of the range", message, &outside, objects.len());
    for anchor in &detector.anchors {
        let of_class: Vec<_> = objects.iter().map(|(_, o)| *o).filter(|o| o.class == anchor.class).collect();
        if !of_class.is_empty() {
            compare_anchor(anchor, &of_class, findings);
        }
    }
}

fn compare_anchor(anchor: &AnchorFacts, labels: &[&ObjectFacts], findings: &mut Findings) {
    let class = &anchor.class;
    let median = |f: &dyn Fn(&ObjectFacts) -> f64| Spread::of(labels.iter().map(|o| f(o))).median;
    let size = [0, 1, 2].map(|i| median(&|o| o.bbox.size[i]));
    let overlap = |o: &ObjectFacts| {
        let shared: f64 = (0..2).map(|i| anchor.size[i].min(o.bbox.size[i])).product();
        shared / (anchor.size[0] * anchor.size[1] + o.bbox.size[0] * o.bbox.size[1] - shared)
    };
    let overlap = median(&overlap);
    if overlap < ANCHOR_OVERLAP {
        let message = format!(
            "the anchor of {class} is {} x {} x {} m (length, width, height), but the labels' median is {:.2} x {:.2} x {:.2} m: \
             with equal centre and yaw their IoU seen from above is {overlap:.2} (median), too little to be matched",
            anchor.size[0], anchor.size[1], anchor.size[2], size[0], size[1], size[2]
        );
        findings.problem("anchors", message, []);
    }
    let ratio = anchor.size[2] / size[2];
    if !(0.5..=2.0).contains(&ratio) {
        let message =
            format!("the anchor of {class} is {} m high, but the labels' median is {:.2} m", anchor.size[2], size[2]);
        findings.problem("anchors", message, []);
    }
    let bottom = median(&|o| o.bbox.z_range().0);
    let (low, high) = (anchor.bottom.max(bottom), (anchor.bottom + anchor.size[2]).min(bottom + size[2]));
    let shared = (high - low).max(0.0) / anchor.size[2].min(size[2]);
    if shared < 0.7 {
        let message = format!(
            "the bottom of the anchor of {class} is at z = {} m, \
             but the median bottom of the labels is at {bottom:.2} m: {:.0} % of the height is shared",
            anchor.bottom,
            shared * 100.0
        );
        // OpenPCDet's PointPillars for KITTI has the anchors of pedestrians and cyclists 1 m too high and still works.
        let learnable = shared >= 0.3;
        let severity = if learnable { super::Severity::Note } else { super::Severity::Problem };
        findings.add(severity, "anchors", message, []);
    }
}
