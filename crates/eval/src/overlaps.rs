//! IoU of every label with every detection of a frame: image, BEV and 3D.

use crate::{EvalFrame, Metric};
use data::{LabelBox, LabelFrame};
use geometry::{Box3, bev_intersection};

/// Indices of a label and a detection that overlap.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Pair {
    pub label: usize,
    pub detection: usize,
    /// Intersection over union, greater than 0. For DontCare regions: intersection over the area of the detection.
    pub overlap: f64,
}

/// All overlapping pairs of a frame, sorted by label, then by detection.
pub(crate) struct FrameOverlaps {
    pub bbox: Vec<Pair>,
    pub bev: Vec<Pair>,
    pub three_d: Vec<Pair>,
    /// Image boxes of DontCare regions.
    pub dont_care: Vec<Pair>,
}

impl FrameOverlaps {
    pub(crate) fn new(frame: &EvalFrame, label_frame: LabelFrame) -> Self {
        let mut out = FrameOverlaps { bbox: vec![], bev: vec![], three_d: vec![], dont_care: vec![] };
        let detected: Vec<Upright> = frame.detections.iter().map(|line| Upright::new(line, label_frame)).collect();
        for (label, line) in frame.labels.iter().enumerate() {
            let labelled = Upright::new(line, label_frame);
            for (detection, other) in frame.detections.iter().enumerate() {
                let push = |pairs: &mut Vec<Pair>, overlap: f64| {
                    if overlap > 0.0 {
                        pairs.push(Pair { label, detection, overlap });
                    }
                };
                let shared = image_intersection(&line.image_box, &other.image_box);
                let (area, other_area) = (image_area(&line.image_box), image_area(&other.image_box));
                if line.is_dont_care() {
                    push(&mut out.dont_care, shared / other_area);
                    continue;
                }
                push(&mut out.bbox, shared / (other_area + area - shared));
                let (bev, three_d) = detected[detection].overlaps(&labelled);
                push(&mut out.bev, bev);
                push(&mut out.three_d, three_d);
            }
        }
        out
    }

    pub(crate) fn of(&self, metric: Metric) -> &[Pair] {
        match metric {
            Metric::Bbox | Metric::Aos => &self.bbox,
            Metric::Bev => &self.bev,
            Metric::ThreeD => &self.three_d,
        }
    }
}

fn image_area(b: &[f64; 4]) -> f64 {
    (b[2] - b[0]) * (b[3] - b[1])
}

fn image_intersection(a: &[f64; 4], b: &[f64; 4]) -> f64 {
    let width = a[2].min(b[2]) - a[0].max(b[0]);
    let height = a[3].min(b[3]) - a[1].max(b[1]);
    if width > 0.0 && height > 0.0 { width * height } else { 0.0 }
}

/// An upright box in the frame in which it is written.
struct Upright {
    base: Box3,
    /// Bottom and top, m.
    height: (f64, f64),
    area: f64,
    volume: f64,
}

/// The box of a line in a z-up frame: unchanged for [`LabelFrame::Lidar`]. For [`LabelFrame::Camera`]: x right, y
/// forward (KITTI's z), z up (KITTI's -y), which is right-handed.
pub(crate) fn upright_box(line: &LabelBox, label_frame: LabelFrame) -> Box3 {
    match label_frame {
        LabelFrame::Lidar => line.lidar_box(),
        LabelFrame::Camera => {
            let ([x, y, z], [h, w, l]) = (line.location, line.size_hwl);
            Box3 { center: [x, z, -y + h / 2.0], size: [l, w, h], yaw_rad: -line.rotation_y }
        }
    }
}

/// Inverse of [`upright_box`]: the line with another box.
pub(crate) fn with_upright_box(line: &LabelBox, b: &Box3, label_frame: LabelFrame) -> LabelBox {
    let ([x, y, z], [l, w, h]) = (b.center, b.size);
    let (location, rotation_y) = match label_frame {
        LabelFrame::Lidar => (b.center, b.yaw_rad),
        LabelFrame::Camera => ([x, -(z - h / 2.0), y], -b.yaw_rad),
    };
    LabelBox { location, rotation_y, size_hwl: [h, w, l], ..line.clone() }
}

impl Upright {
    fn new(line: &LabelBox, label_frame: LabelFrame) -> Self {
        let [h, w, l] = line.size_hwl;
        let base = upright_box(line, label_frame);
        let height = match label_frame {
            LabelFrame::Lidar => base.z_range(),
            LabelFrame::Camera => (-line.location[1], -line.location[1] + h),
        };
        Upright { base, height, area: l * w, volume: l * h * w }
    }

    /// BEV and 3D IoU.
    fn overlaps(&self, other: &Upright) -> (f64, f64) {
        let shared = bev_intersection(&self.base, &other.base);
        if shared <= 0.0 {
            return (0.0, 0.0);
        }
        let bev = shared / (self.area + other.area - shared);
        let high = self.height.1.min(other.height.1) - self.height.0.max(other.height.0);
        if high <= 0.0 || self.volume <= 0.0 || other.volume <= 0.0 {
            return (bev, 0.0);
        }
        let shared = high * shared;
        (bev, shared / (self.volume + other.volume - shared))
    }
}

/// Ground-plane distance of a box, m.
pub(crate) fn range_m(line: &LabelBox, label_frame: LabelFrame) -> f64 {
    let [x, y, z] = line.location;
    match label_frame {
        LabelFrame::Camera => x.hypot(z),
        LabelFrame::Lidar => x.hypot(y),
    }
}
