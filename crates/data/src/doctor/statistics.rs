//! Counts, sizes and ranges; boxes without points, with implausible sizes or far from the ground.

use super::report::{ClassFacts, Findings, PointFacts, Spread, at_most};
use super::survey::{FrameFacts, ObjectFacts};
use crate::Dataset;
use std::collections::{BTreeMap, BTreeSet};

/// Largest plausible distance between the bottom of a box and the ground, m. Far away the ground height is inaccurate.
const MAX_GROUND_OFFSET_M: f64 = 1.0;

pub(super) fn points(frames: &[FrameFacts], findings: &mut Findings) -> PointFacts {
    if frames.is_empty() {
        return PointFacts::default();
    }
    let mut range_m = frames[0].range;
    let mut intensity = frames[0].intensity;
    for frame in frames {
        for i in 0..3 {
            range_m[i] = range_m[i].min(frame.range[i]);
            range_m[i + 3] = range_m[i + 3].max(frame.range[i + 3]);
        }
        if let (Some(all), Some(one)) = (&mut intensity, frame.intensity) {
            *all = [all[0].min(one[0]), all[1].max(one[1])];
        }
    }
    if let Some([low, high]) = intensity
        && (low < 0.0 || high > 1.0)
    {
        findings.note(
            "intensity",
            format!("intensities are from {low} to {high}; networks trained on KITTI expect 0 to 1"),
            [],
        );
    }
    PointFacts { per_frame: Spread::of(frames.iter().map(|f| f.points as f64)), range_m, intensity }
}

pub(super) fn classes(dataset: &Dataset, frames: &[FrameFacts], findings: &mut Findings) -> Vec<ClassFacts> {
    let mut by_class: BTreeMap<&str, Vec<(&str, &ObjectFacts)>> = BTreeMap::new();
    for frame in frames {
        for object in &frame.objects {
            by_class.entry(&object.class).or_default().push((&frame.id, object));
        }
    }
    let listed = &dataset.config.classes;
    if by_class.is_empty() && !frames.is_empty() {
        let why = if dataset.has_labels() { "all label files are empty" } else { "there is no folder of labels" };
        findings.problem("labels", format!("the data set has no labelled box: {why}"), []);
    } else if !frames.is_empty() && !listed.iter().any(|class| by_class.contains_key(class.as_str())) {
        let found: Vec<_> = by_class.keys().map(|c| c.to_string()).collect();
        let message =
            format!("no box is of a listed class ({}); the labels have {}", listed.join(", "), found.join(", "));
        findings.problem("classes", message, []);
    } else {
        let missing: Vec<_> = listed.iter().filter(|class| !by_class.contains_key(class.as_str())).cloned().collect();
        if !missing.is_empty() {
            findings.note("classes", format!("listed classes without a box: {}", missing.join(", ")), []);
        }
        let unlisted: Vec<_> = by_class
            .iter()
            .filter(|(class, _)| !listed.iter().any(|l| l == *class))
            .map(|(class, boxes)| format!("{class} ({} boxes)", boxes.len()))
            .collect();
        if !unlisted.is_empty() {
            findings.note(
                "classes",
                format!("labelled but not in the list of classes, therefore left out: {}", unlisted.join(", ")),
                [],
            );
        }
    }
    let all: Vec<_> = by_class.values().flatten().copied().collect();
    let empty: Vec<_> = all.iter().filter(|(_, o)| o.points == 0).map(|(id, o)| at(id, o)).collect();
    let message = format!("{} of {} boxes have no point inside: {}", empty.len(), all.len(), at_most(5, &empty, ", "));
    findings.by_share("boxes without points", message, &empty, all.len());
    let implausible = |o: &ObjectFacts| o.bbox.size.iter().any(|s| !(0.05..40.0).contains(s));
    let implausible: Vec<_> = all.iter().filter(|(_, o)| implausible(o)).map(|(id, o)| at(id, o)).collect();
    if !implausible.is_empty() {
        let message = format!(
            "{} boxes have a side below 5 cm or above 40 m: {}",
            implausible.len(),
            at_most(5, &implausible, ", ")
        );
        findings.problem("sizes", message, implausible);
    }
    let facts = |(class, boxes): (&&str, &Vec<(&str, &ObjectFacts)>)| {
        let spread = |f: &dyn Fn(&ObjectFacts) -> f64| Spread::of(boxes.iter().map(|(_, o)| f(o)));
        ClassFacts {
            class: class.to_string(),
            listed: listed.iter().any(|l| l == class),
            boxes: boxes.len(),
            length_m: spread(&|o| o.bbox.size[0]),
            width_m: spread(&|o| o.bbox.size[1]),
            height_m: spread(&|o| o.bbox.size[2]),
            bottom_m: spread(&|o| o.bbox.z_range().0),
            range_m: spread(&|o| o.bbox.center[0].hypot(o.bbox.center[1])),
            points: spread(&|o| o.points as f64),
            without_points: boxes.iter().filter(|(_, o)| o.points == 0).count(),
        }
    };
    by_class.iter().map(facts).collect()
}

pub(super) fn ground(frames: &[FrameFacts], findings: &mut Findings) {
    let mut known = 0;
    let mut far = Vec::new();
    let mut offsets = Vec::new();
    let mut frames_with_far = BTreeSet::new();
    for frame in frames {
        for object in &frame.objects {
            let Some(ground) = object.ground else { continue };
            known += 1;
            let offset = object.bbox.z_range().0 - ground;
            offsets.push(offset);
            if offset.abs() > MAX_GROUND_OFFSET_M {
                far.push(format!("{} ({offset:+.1} m)", at(&frame.id, object)));
                frames_with_far.insert(frame.id.clone());
            }
        }
    }
    let message = format!(
        "{} of {known} boxes have their bottom more than {MAX_GROUND_OFFSET_M} m above or below the ground \
         (median over all boxes {:+.2} m): {}",
        far.len(),
        Spread::of(offsets).median,
        at_most(5, &far, ", ")
    );
    findings.by_share("boxes far from the ground", message, &far, known);
}

/// Frame id, class and centre of a box, for messages.
pub(super) fn at(id: &str, object: &ObjectFacts) -> String {
    let [x, y, z] = object.bbox.center;
    format!("{id} {} at ({x:.1}, {y:.1}, {z:.1})", object.class)
}
