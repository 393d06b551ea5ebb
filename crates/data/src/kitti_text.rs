//! KITTI's text format for labels and detections: one object a line with 15 values; detections have a score as value
//! 16.
//!
//! The same columns are used for both label frames ([`crate::LabelFrame`]). This module does not convert between them.
//! The rest of the program uses [`LabelBox`].

use crate::limits::{MOST_BOXES, at_most, read_text};
use crate::{DONT_CARE, DataError, LabelBox};
use std::{fmt, path::Path};

/// Largest absolute coordinate of a valid location, m.
const FARTHEST_M: f64 = 10_000.0;

const FIELDS: [&str; 16] = [
    "class",
    "truncation",
    "occlusion",
    "alpha",
    "image box left",
    "image box top",
    "image box right",
    "image box bottom",
    "height",
    "width",
    "length",
    "location x",
    "location y",
    "location z",
    "rotation_y",
    "score",
];

/// Kind of a KITTI text.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum KittiText {
    /// Labels: 15 values a line.
    Labels,
    /// Detections: 16 values a line, the last one is the score.
    Detections,
}

impl KittiText {
    fn fields(self) -> usize {
        match self {
            KittiText::Labels => 15,
            KittiText::Detections => 16,
        }
    }
}

/// Parses a box of one line.
pub(crate) fn parse_kitti_line(text: &str, kind: KittiText) -> Result<LabelBox, String> {
    let fields: Vec<&str> = text.split_ascii_whitespace().collect();
    if fields.len() != kind.fields() {
        let (what, found, wanted) = match kind {
            KittiText::Labels => ("a label", fields.len(), "15 values"),
            KittiText::Detections => ("a detection", fields.len(), "16 values, the last one is the score"),
        };
        return Err(format!("{what} has {wanted}; this line has {found}"));
    }
    let mut v = [0.0; 16]; // same indices as FIELDS; v[0] is unused
    for (i, field) in fields.iter().enumerate().skip(1) {
        v[i] = match field.parse::<f64>() {
            Ok(number) if number.is_finite() => number,
            Ok(_) => return Err(format!("{} (value {}) is {field}, not a finite number", FIELDS[i], i + 1)),
            Err(_) => return Err(format!("{} (value {}) is '{field}', not a number", FIELDS[i], i + 1)),
        };
    }
    let label = LabelBox {
        class: fields[0].into(),
        truncation: v[1],
        occlusion: v[2],
        alpha: v[3],
        image_box: [v[4], v[5], v[6], v[7]],
        size_hwl: [v[8], v[9], v[10]],
        location: [v[11], v[12], v[13]],
        rotation_y: v[14],
        score: (kind == KittiText::Detections).then_some(v[15]),
        track: None,
    };
    check_box(&label, kind).map_err(|(i, problem)| format!("{} (value {}) {problem}", FIELDS[i], i + 1))?;
    Ok(label)
}

/// Whether a box is possible; else the index of its value in [`FIELDS`], and what is wrong with it.
fn check_box(label: &LabelBox, kind: KittiText) -> Result<(), (usize, String)> {
    let dont_care = label.class.eq_ignore_ascii_case(DONT_CARE);
    if !label.has_box() && (kind == KittiText::Detections || dont_care) {
        return Ok(());
    }
    for (i, size) in label.size_hwl.iter().enumerate() {
        if *size < 0.0 {
            return Err((8 + i, format!("is {size}; a size cannot be negative")));
        }
        if *size == 0.0 && kind == KittiText::Labels && !dont_care {
            return Err((8 + i, "is 0; the size of a labelled object must be positive".into()));
        }
    }
    match label.location.iter().position(|v| v.abs() > FARTHEST_M) {
        Some(i) => Err((11 + i, format!("is {} m, farther than 10 km", label.location[i]))),
        None => Ok(()),
    }
}

/// Whether a detection of a table is possible; else what is wrong with it.
pub(crate) fn check_detection(detection: &LabelBox) -> Result<(), String> {
    check_box(detection, KittiText::Detections).map_err(|(i, problem)| format!("{} {problem}", FIELDS[i]))
}

/// Formats a box as a line of KITTI text, without a line feed. Reading it gives bit-identical numbers. The track is not
/// written, because the format has no column for it.
pub struct KittiLine<'a>(pub &'a LabelBox);

impl fmt::Display for KittiLine<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let label = self.0;
        write!(f, "{} {} {} {}", label.class, label.truncation, label.occlusion, label.alpha)?;
        for v in label.image_box.iter().chain(&label.size_hwl).chain(&label.location) {
            write!(f, " {v}")?;
        }
        write!(f, " {}", label.rotation_y)?;
        label.score.map_or(Ok(()), |score| write!(f, " {score}"))
    }
}

/// Parses a text, one box a line. Blank lines are skipped. `path` is used in error messages.
pub fn parse_kitti_text(text: &str, path: &Path, kind: KittiText) -> Result<Vec<LabelBox>, DataError> {
    let lines = || text.lines().enumerate().filter(|(_, line)| !line.trim_ascii().is_empty());
    at_most(path, "boxes", lines().count() as u64, MOST_BOXES)?;
    lines()
        .map(|(i, line)| parse_kitti_line(line, kind).map_err(|message| DataError::line(path, i + 1, message)))
        .collect()
}

/// Reads a file of labels or detections.
pub fn read_kitti_text(path: &Path, kind: KittiText) -> Result<Vec<LabelBox>, DataError> {
    parse_kitti_text(&read_text(path)?, path, kind)
}

/// Formats boxes as KITTI text, one a line.
pub fn to_kitti_text<'a>(labels: impl IntoIterator<Item = &'a LabelBox>) -> String {
    labels.into_iter().map(|label| format!("{}\n", KittiLine(label))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use geometry::Box3;

    const LABEL: &str = "Car 0.00 0 1.85 387.63 181.54 423.81 203.12 1.67 1.87 3.69 -16.53 2.39 58.49 1.57";

    fn read(text: &str, kind: KittiText) -> Result<Vec<LabelBox>, String> {
        parse_kitti_text(text, Path::new("labels/7.txt"), kind).map_err(|e| e.to_string())
    }

    #[test]
    fn texts_round_trip() {
        let text = format!("{LABEL}\n\nDontCare -1 -1 -10 1 2 3 4 -1 -1 -1 -1000 -1000 -1000 -10\r\n");
        let lines = read(&text, KittiText::Labels).unwrap();
        assert_eq!(lines.len(), 2);
        assert_eq!(lines[0].size_hwl, [1.67, 1.87, 3.69]);
        assert_eq!(lines[0].location, [-16.53, 2.39, 58.49]);
        assert!(lines[1].is_dont_care() && !lines[1].has_box());
        assert_eq!(read(&to_kitti_text(&lines), KittiText::Labels).unwrap(), lines);

        let bbox = Box3::from_array([10.1, -3.0, -0.7, 4.88, 1.9, 1.18, 0.1 + 0.2]);
        let lines = vec![LabelBox::from_box("Car", &bbox, Some(0.1))];
        let again = read(&to_kitti_text(&lines), KittiText::Detections).unwrap();
        assert_eq!(again, lines);
        assert_eq!(again[0].lidar_box(), bbox);
    }

    #[test]
    fn an_empty_text_has_no_objects() {
        for kind in [KittiText::Labels, KittiText::Detections] {
            assert_eq!(read("", kind).unwrap(), vec![]);
        }
    }

    #[test]
    fn invalid_lines_are_reported_with_their_number() {
        let bad = [
            (LABEL.rsplit_once(' ').unwrap().0.to_string(), "15 values; this line has 14"),
            (format!("{LABEL} 0.5"), "15 values; this line has 16"),
            (LABEL.replace("1.67", "tall"), "height (value 9) is 'tall', not a number"),
            (LABEL.replace("1.67", "-1.67"), "height (value 9) is -1.67; a size cannot be negative"),
            (LABEL.replace("1.87", "0"), "width (value 10) is 0"),
            (LABEL.replace("58.49", "NaN"), "location z (value 14) is NaN, not a finite number"),
            (LABEL.replace("58.49", "1e999"), "not a finite number"),
            (LABEL.replace("58.49", "58490"), "farther than 10 km"),
            (LABEL.replace("1.67 1.87 3.69", "-1 -1 -1"), "cannot be negative"),
        ];
        for (line, message) in bad {
            let error = read(&format!("{LABEL}\n{line}\n"), KittiText::Labels).unwrap_err();
            assert!(error.starts_with("labels/7.txt:2: ") && error.contains(message), "{error}");
        }
        let error = read(LABEL, KittiText::Detections).unwrap_err();
        assert!(error.contains("16 values") && error.contains("has 15"), "{error}");
    }

    #[test]
    fn a_detection_may_be_without_a_3d_box() {
        let line = "Car -1 -1 0.1 1 2 3 4 -1 -1 -1 -1000 -1000 -1000 -10 0.5";
        assert!(!read(line, KittiText::Detections).unwrap()[0].has_box());
        assert!(read(&line.replacen(" -1 -1 -1 ", " -1 2 2 ", 1), KittiText::Detections).is_err());
    }
}
