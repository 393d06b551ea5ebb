//! KITTI's text for labels and detections: one object a line, fifteen values, for detections a score as the sixteenth.
//!
//! The same columns are read in two frames ([`LabelFrame`]). Nothing here converts between them: the numbers are kept as written.

use crate::DataError;
use geometry::Box3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::{fmt, path::Path};

/// The class of regions in which nothing was labelled. They have an image box, but no 3D box.
pub const DONT_CARE: &str = "DontCare";

/// What KITTI writes for each size of an object that has no 3D box.
const NO_SIZE: [f64; 3] = [-1.0; 3];

/// Locations beyond this are damage, m.
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

/// The frame in which the 3D boxes of a text are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum LabelFrame {
    /// KITTI's own convention: x right, y down, z forward; the location is the centre of the bottom; rotation about y.
    Camera,
    /// KITTI's columns, but the location is the centre of the box in the cloud's frame and the rotation is the yaw,
    /// counter-clockwise from +x.
    Lidar,
}

/// Which of the two kinds a text is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum KittiText {
    /// Fifteen values a line.
    Labels,
    /// Sixteen values a line, the last one is the score.
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

/// One object as the text writes it. Which frame `location` and `rotation_y` are in, the text does not say: see [`LabelFrame`].
#[derive(Clone, Debug, PartialEq)]
pub struct KittiLine {
    /// Class, in the letters of the text.
    pub class: String,
    /// 0 (all of it in the image) to 1; -1 where not known.
    pub truncation: f64,
    /// 0 (visible), 1, 2 (largely occluded), 3 (unknown); -1 where not known.
    pub occlusion: f64,
    /// Direction of the object relative to the ray from the camera, rad; -10 where not known.
    pub alpha: f64,
    /// Left, top, right, bottom, px.
    pub image_box: [f64; 4],
    /// Height, width, length, m; all -1 where there is no 3D box.
    pub size_hwl: [f64; 3],
    /// Camera frame: bottom centre. LiDAR frame: centre. m; -1000 where there is no 3D box.
    pub location: [f64; 3],
    /// Camera frame: rotation about y. LiDAR frame: yaw. rad; -10 where there is no 3D box.
    pub rotation_y: f64,
    /// Confidence of a detection; larger is surer. `None` for labels.
    pub score: Option<f64>,
}

impl KittiLine {
    /// The line of a box of the LiDAR frame, for texts in [`LabelFrame::Lidar`]: a label without a score, a detection with one.
    ///
    /// There is no image, so the image box is 0 0 50 50 as OpenPCDet writes it then, and alpha is -10 (unknown). Truncation and
    /// occlusion are 0 for labels and -1 for detections.
    pub fn from_box(class: &str, bbox: &Box3, score: Option<f32>) -> Self {
        let seen = if score.is_some() { -1.0 } else { 0.0 };
        let [dx, dy, dz] = bbox.size;
        KittiLine {
            class: class.into(),
            truncation: seen,
            occlusion: seen,
            alpha: -10.0,
            image_box: [0.0, 0.0, 50.0, 50.0],
            size_hwl: [dz, dy, dx],
            location: bbox.center,
            rotation_y: bbox.yaw_rad,
            score: score.map(f64::from),
        }
    }

    /// The box of a line that is written in [`LabelFrame::Lidar`]; the inverse of [`KittiLine::from_box`].
    pub fn lidar_box(&self) -> Box3 {
        let [h, w, l] = self.size_hwl;
        Box3 { center: self.location, size: [l, w, h], yaw_rad: self.rotation_y }
    }

    /// Whether this is a region in which nothing was labelled.
    pub fn is_dont_care(&self) -> bool {
        self.class == DONT_CARE
    }

    /// Whether there is a 3D box, not only an image box (KITTI then writes -1 for all sizes).
    pub fn has_box(&self) -> bool {
        self.size_hwl != NO_SIZE
    }

    fn parse(text: &str, kind: KittiText) -> Result<Self, String> {
        let fields: Vec<&str> = text.split_ascii_whitespace().collect();
        if fields.len() != kind.fields() {
            let (what, found, wanted) = match kind {
                KittiText::Labels => ("a label", fields.len(), "15 values"),
                KittiText::Detections => ("a detection", fields.len(), "16 values, the last one is the score"),
            };
            return Err(format!("{what} has {wanted}; this line has {found}"));
        }
        let mut v = [0.0; 16]; // v[0] is unused, so that the numbers stand where FIELDS has their names
        for (i, field) in fields.iter().enumerate().skip(1) {
            v[i] = match field.parse::<f64>() {
                Ok(number) if number.is_finite() => number,
                Ok(_) => return Err(format!("{} (value {}) is {field}, not a finite number", FIELDS[i], i + 1)),
                Err(_) => return Err(format!("{} (value {}) is '{field}', not a number", FIELDS[i], i + 1)),
            };
        }
        let line = KittiLine {
            class: fields[0].into(),
            truncation: v[1],
            occlusion: v[2],
            alpha: v[3],
            image_box: [v[4], v[5], v[6], v[7]],
            size_hwl: [v[8], v[9], v[10]],
            location: [v[11], v[12], v[13]],
            rotation_y: v[14],
            score: (kind == KittiText::Detections).then_some(v[15]),
        };
        line.check_box(kind)?;
        Ok(line)
    }

    fn check_box(&self, kind: KittiText) -> Result<(), String> {
        let dont_care = self.class.eq_ignore_ascii_case(DONT_CARE);
        if !self.has_box() && (kind == KittiText::Detections || dont_care) {
            return Ok(());
        }
        for (i, size) in self.size_hwl.iter().enumerate() {
            let name = FIELDS[8 + i];
            if *size < 0.0 {
                return Err(format!("{name} (value {}) is {size}; a size cannot be negative", 9 + i));
            }
            if *size == 0.0 && kind == KittiText::Labels && !dont_care {
                return Err(format!("{name} (value {}) is 0; a labelled object has a size", 9 + i));
            }
        }
        if let Some(i) = self.location.iter().position(|v| v.abs() > FARTHEST_M) {
            let (name, number) = (FIELDS[11 + i], 12 + i);
            return Err(format!("{name} (value {number}) is {} m, farther than 10 km", self.location[i]));
        }
        Ok(())
    }
}

/// The line, without a line end. Reading it gives the same numbers to the bit.
impl fmt::Display for KittiLine {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {} {} {}", self.class, self.truncation, self.occlusion, self.alpha)?;
        for v in self.image_box.iter().chain(&self.size_hwl).chain(&self.location) {
            write!(f, " {v}")?;
        }
        write!(f, " {}", self.rotation_y)?;
        self.score.map_or(Ok(()), |score| write!(f, " {score}"))
    }
}

/// Reads a text, line by line; blank lines are left out. `path` is for the messages.
pub fn parse_kitti_text(text: &str, path: &Path, kind: KittiText) -> Result<Vec<KittiLine>, DataError> {
    let lines = text.lines().enumerate().filter(|(_, line)| !line.trim_ascii().is_empty());
    lines
        .map(|(i, line)| KittiLine::parse(line, kind).map_err(|message| DataError::line(path, i + 1, message)))
        .collect()
}

/// Reads a file of labels or detections.
pub fn read_kitti_text(path: &Path, kind: KittiText) -> Result<Vec<KittiLine>, DataError> {
    parse_kitti_text(&fs_err::read_to_string(path)?, path, kind)
}

/// The text of these objects, one a line.
pub fn to_kitti_text<'a>(lines: impl IntoIterator<Item = &'a KittiLine>) -> String {
    lines.into_iter().map(|line| format!("{line}\n")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const LABEL: &str = "Car 0.00 0 1.85 387.63 181.54 423.81 203.12 1.67 1.87 3.69 -16.53 2.39 58.49 1.57";

    fn read(text: &str, kind: KittiText) -> Result<Vec<KittiLine>, String> {
        parse_kitti_text(text, Path::new("labels/7.txt"), kind).map_err(|e| e.to_string())
    }

    #[test]
    fn what_is_written_reads_back_the_same() {
        let text = format!("{LABEL}\n\nDontCare -1 -1 -10 1 2 3 4 -1 -1 -1 -1000 -1000 -1000 -10\r\n");
        let lines = read(&text, KittiText::Labels).unwrap();
        assert_eq!(lines.len(), 2);
        assert_eq!(lines[0].size_hwl, [1.67, 1.87, 3.69]);
        assert_eq!(lines[0].location, [-16.53, 2.39, 58.49]);
        assert!(lines[1].is_dont_care() && !lines[1].has_box());
        assert_eq!(read(&to_kitti_text(&lines), KittiText::Labels).unwrap(), lines);

        let bbox = Box3::from_array([10.1, -3.0, -0.7, 4.88, 1.9, 1.18, 0.1 + 0.2]);
        let lines = vec![KittiLine::from_box("Car", &bbox, Some(0.1))];
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
    fn bad_lines_are_named() {
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
