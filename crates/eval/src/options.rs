//! Evaluation input and settings.

use data::{LabelBox, LabelFrame};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::fmt;

/// Ground truth and detections of one frame, as written in their files.
#[derive(Clone, Debug, PartialEq)]
pub struct EvalFrame {
    /// File name without extension.
    pub id: String,
    /// Label lines, including DontCare.
    pub labels: Vec<LabelBox>,
    /// Detection lines; each has a score.
    pub detections: Vec<LabelBox>,
}

/// Evaluation settings.
#[derive(Clone, Debug, PartialEq)]
pub struct EvalOptions {
    /// Classes in report order, compared case-insensitively. Empty: [`default_classes`].
    pub classes: Vec<String>,
    /// Coordinate frame of labels and detections. Boxes are compared as written, without conversion.
    pub label_frame: LabelFrame,
    /// Ground truth and detections whose centre is farther away on the ground plane are ignored: neither true
    /// positive, false negative nor false positive.
    pub max_range_m: Option<f64>,
    /// Additional overlap limits in [0, 1), for every class and metric.
    pub more_overlaps: Vec<f64>,
}

impl Default for EvalOptions {
    fn default() -> Self {
        EvalOptions {
            classes: Vec::new(),
            label_frame: LabelFrame::Camera,
            max_range_m: None,
            more_overlaps: Vec::new(),
        }
    }
}

/// A range section: an interval of ground-plane distances, m.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RangeSection {
    /// Lower bound, inclusive, m.
    pub from_m: f64,
    /// Upper bound, m.
    pub to_m: f64,
    /// Whether `to_m` is included.
    #[serde(default)]
    pub closed: bool,
}

impl RangeSection {
    /// The paper's close, mid and long range: [0, 33.3), [33.3, 66.6), [66.6, 100] m (section III-B).
    pub const PAPER: [RangeSection; 3] = [
        RangeSection { from_m: 0.0, to_m: 33.3, closed: false },
        RangeSection { from_m: 33.3, to_m: 66.6, closed: false },
        RangeSection { from_m: 66.6, to_m: 100.0, closed: true },
    ];

    /// All distances up to and including `to_m`.
    pub fn up_to(to_m: f64) -> Self {
        RangeSection { from_m: 0.0, to_m, closed: true }
    }

    /// Whether a ground-plane distance (m) is in the section.
    pub fn contains(&self, range_m: f64) -> bool {
        range_m >= self.from_m && (range_m < self.to_m || (self.closed && range_m == self.to_m))
    }
}

impl fmt::Display for RangeSection {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "[{}, {}{} m", self.from_m, self.to_m, if self.closed { ']' } else { ')' })
    }
}

/// How two boxes are compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Metric {
    /// 2D IoU of image boxes.
    Bbox,
    /// Average orientation similarity: as [`Metric::Bbox`], with each true positive weighted by its observation angle
    /// error.
    Aos,
    /// Rotated boxes in bird's eye view.
    Bev,
    /// Upright 3D boxes.
    #[serde(rename = "3d")]
    ThreeD,
}

impl fmt::Display for Metric {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Metric::Bbox => "bbox",
            Metric::Aos => "aos",
            Metric::Bev => "bev",
            Metric::ThreeD => "3d",
        })
    }
}

/// Difficulty level: which ground truths are counted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Difficulty {
    /// Image box height over 40 px, not occluded, truncation up to 0.15.
    Easy,
    /// Height over 25 px, partly occluded, truncation up to 0.3.
    Moderate,
    /// Height over 25 px, largely occluded, truncation up to 0.5.
    Hard,
    /// Every label of the class: no filter, no neighbouring classes, no DontCare; otherwise KITTI's matching.
    All,
}

impl fmt::Display for Difficulty {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(["easy", "moderate", "hard", "all"][*self as usize])
    }
}

impl Difficulty {
    /// In report order.
    pub const ALL: [Difficulty; 4] = [Difficulty::Easy, Difficulty::Moderate, Difficulty::Hard, Difficulty::All];

    /// Ground truths with an image box of at most this height are not counted, and detections below it are ignored,
    /// px.
    pub(crate) fn least_height_px(self) -> f64 {
        [40.0, 25.0, 25.0, f64::NEG_INFINITY][self as usize]
    }

    pub(crate) fn most_occlusion(self) -> f64 {
        [0.0, 1.0, 2.0, f64::INFINITY][self as usize]
    }

    pub(crate) fn most_truncation(self) -> f64 {
        [0.15, 0.3, 0.5, f64::INFINITY][self as usize]
    }
}

/// Overlap limits of the reference for a class and metric: the official one, and that of OpenPCDet's second, loose
/// set. Classes unknown to the reference use those of Car.
pub fn reference_overlaps(class: &str, metric: Metric) -> [f64; 2] {
    let small = ["pedestrian", "cyclist", "person_sitting"].iter().any(|name| name.eq_ignore_ascii_case(class));
    let (official, loose) = if small { (0.5, 0.25) } else { (0.7, 0.5) };
    match metric {
        Metric::Bbox | Metric::Aos => [official, official],
        Metric::Bev | Metric::ThreeD => [official, loose],
    }
}

/// Classes reported if none is given: those in labels and detections, KITTI's three first. Excludes DontCare and the
/// classes that KITTI labels but does not evaluate.
pub fn default_classes(frames: &[EvalFrame]) -> Vec<String> {
    const LEFT_OUT: [&str; 6] = [data::DONT_CARE, "Van", "Person_sitting", "Truck", "Tram", "Misc"];
    let mut found: Vec<&str> = Vec::new();
    for class in frames.iter().flat_map(|f| f.labels.iter().chain(&f.detections)).map(|b| b.class.as_str()) {
        if !LEFT_OUT.iter().chain(&found).any(|name| name.eq_ignore_ascii_case(class)) {
            found.push(class);
        }
    }
    let kitti = ["Car", "Pedestrian", "Cyclist"];
    let of_kitti = kitti.iter().filter(|name| found.iter().any(|f| f.eq_ignore_ascii_case(name)));
    let mut others: Vec<&str> =
        found.iter().copied().filter(|f| !kitti.iter().any(|k| k.eq_ignore_ascii_case(f))).collect();
    others.sort_unstable();
    of_kitti.copied().chain(others).map(String::from).collect()
}
