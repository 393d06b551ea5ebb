//! Detections in another frame than the labels: which flip, turn or exchange of axes makes them overlap.

use crate::EvalFrame;
use crate::overlaps::upright_box;
use data::{LabelBox, LabelFrame};
use geometry::{Box3, iou_3d};
use rayon::prelude::*;
use std::f64::consts::{FRAC_PI_2, PI};
use std::fmt;

/// A label counts as overlapped if a detection of its class has a larger 3D IoU. Above 1/3, which is the IoU of a box
/// with itself shifted by half of its height.
pub const TRANSFORM_OVERLAP: f64 = 0.4;
/// Number of frames that are tested at most.
const MOST_FRAMES: usize = 300;
/// Boxes whose centres are farther apart are not compared, m.
const FAR_M: f64 = 20.0;

/// A wrong convention of boxes, by what corrects it. Axes: x forward, y left, z up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BoxTransform {
    /// y and yaw change their sign.
    MirrorY,
    /// x changes its sign, and yaw becomes half a turn minus yaw.
    MirrorX,
    /// A turn about the vertical axis by 90 degrees, counter-clockwise.
    TurnLeft,
    /// The same clockwise.
    TurnRight,
    /// The same by 180 degrees.
    TurnRound,
    /// The columns are those of the other label frame: KITTI's camera frame for labels in the LiDAR frame and the
    /// reverse.
    OtherFrame,
    /// The location is the centre of the bottom face instead of the centre of the box.
    FromBottom,
    /// The location is the centre of the box instead of the centre of the bottom face.
    FromCentre,
    /// Length and width are exchanged, or yaw is measured from another axis.
    TurnBox,
    /// Yaw is measured clockwise from the y axis.
    MirrorYaw,
}

impl BoxTransform {
    /// All of them, in the order in which they are preferred.
    pub const ALL: [BoxTransform; 10] = [
        BoxTransform::MirrorY,
        BoxTransform::MirrorX,
        BoxTransform::TurnLeft,
        BoxTransform::TurnRight,
        BoxTransform::TurnRound,
        BoxTransform::OtherFrame,
        BoxTransform::FromBottom,
        BoxTransform::FromCentre,
        BoxTransform::TurnBox,
        BoxTransform::MirrorYaw,
    ];

    /// The corrected box of a detection.
    fn apply(self, line: &LabelBox, label_frame: LabelFrame) -> Box3 {
        let as_given = forward_left_up(line, label_frame);
        let Box3 { center: [x, y, z], size, yaw_rad } = as_given;
        let made = |center: [f64; 3], yaw_rad: f64| Box3 { center, size, yaw_rad };
        match self {
            BoxTransform::MirrorY => made([x, -y, z], -yaw_rad),
            BoxTransform::MirrorX => made([-x, y, z], PI - yaw_rad),
            BoxTransform::TurnLeft => made([-y, x, z], yaw_rad + FRAC_PI_2),
            BoxTransform::TurnRight => made([y, -x, z], yaw_rad - FRAC_PI_2),
            BoxTransform::TurnRound => made([-x, -y, z], yaw_rad + PI),
            BoxTransform::OtherFrame => forward_left_up(line, other(label_frame)),
            BoxTransform::FromBottom => made([x, y, z + size[2] / 2.0], yaw_rad),
            BoxTransform::FromCentre => made([x, y, z - size[2] / 2.0], yaw_rad),
            BoxTransform::TurnBox => made([x, y, z], yaw_rad + FRAC_PI_2),
            BoxTransform::MirrorYaw => made([x, y, z], -yaw_rad - FRAC_PI_2),
        }
    }
}

impl fmt::Display for BoxTransform {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            BoxTransform::MirrorY => "mirroring y (left and right), with yaw",
            BoxTransform::MirrorX => "mirroring x (front and back), with yaw",
            BoxTransform::TurnLeft => "turning by 90 degrees counter-clockwise about z",
            BoxTransform::TurnRight => "turning by 90 degrees clockwise about z",
            BoxTransform::TurnRound => "turning by 180 degrees about z",
            BoxTransform::OtherFrame => {
                "reading the columns in the other label frame (camera instead of LiDAR, or the reverse)"
            }
            BoxTransform::FromBottom => {
                "raising boxes by half of their height (the location is the centre of the bottom face)"
            }
            BoxTransform::FromCentre => {
                "lowering boxes by half of their height (the location is the centre of the box)"
            }
            BoxTransform::TurnBox => "turning each box by 90 degrees about its own centre (length and width exchanged, or yaw from the y axis)",
            BoxTransform::MirrorYaw => "replacing yaw by -yaw - 90 degrees",
        })
    }
}

fn other(label_frame: LabelFrame) -> LabelFrame {
    match label_frame {
        LabelFrame::Camera => LabelFrame::Lidar,
        LabelFrame::Lidar => LabelFrame::Camera,
    }
}

/// The box with axes forward, left, up. The mounting of camera and LiDAR is not considered.
fn forward_left_up(line: &LabelBox, label_frame: LabelFrame) -> Box3 {
    let b = upright_box(line, label_frame);
    match label_frame {
        LabelFrame::Lidar => b,
        LabelFrame::Camera => {
            let [right, forward, up] = b.center;
            Box3 { center: [forward, -right, up], size: b.size, yaw_rad: b.yaw_rad - FRAC_PI_2 }
        }
    }
}

/// How many labels are overlapped by detections, as given and corrected.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TransformFit {
    /// Frames that were tested.
    pub frames: usize,
    /// Labels of the tested classes in them.
    pub labels: usize,
    /// Labels that are overlapped as the detections are given.
    pub as_given: usize,
    /// The transform with the most overlapped labels, and their number.
    pub best: (BoxTransform, usize),
}

impl TransformFit {
    /// Tests the detections of some frames, evenly spaced, in these classes (any case).
    pub fn of(frames: &[EvalFrame], label_frame: LabelFrame, classes: &[String]) -> TransformFit {
        let has_label = |frame: &&EvalFrame| frame.labels.iter().any(|line| is_of(line, classes));
        let labelled: Vec<&EvalFrame> = frames.iter().filter(has_label).collect();
        let n = labelled.len().min(MOST_FRAMES);
        let tested: Vec<&EvalFrame> = (0..n).map(|i| labelled[i * labelled.len() / n]).collect();
        let counts = tested.par_iter().map(|frame| overlapped(frame, label_frame, classes));
        let none = || (0, 0, [0; BoxTransform::ALL.len()]);
        let (labels, as_given, corrected) =
            counts.reduce(none, |a, b| (a.0 + b.0, a.1 + b.1, std::array::from_fn(|k| a.2[k] + b.2[k])));
        let mut best = (BoxTransform::ALL[0], corrected[0]);
        for (transform, count) in BoxTransform::ALL.into_iter().zip(corrected) {
            if count > best.1 {
                best = (transform, count);
            }
        }
        TransformFit { frames: n, labels, as_given, best }
    }

    /// Whether the best transform fits clearly better than the boxes as given: at least a tenth of the labels, and
    /// more than twice as many as without it.
    pub fn is_wrong(&self) -> bool {
        self.best.1 >= 2 * self.as_given + 3 && 10 * self.best.1 >= self.labels
    }
}

fn is_of(line: &LabelBox, classes: &[String]) -> bool {
    line.has_box() && classes.iter().any(|class| class.eq_ignore_ascii_case(&line.class))
}

/// Number of labels, of those overlapped as given, and of those overlapped after each transform.
fn overlapped(
    frame: &EvalFrame,
    label_frame: LabelFrame,
    classes: &[String],
) -> (usize, usize, [usize; BoxTransform::ALL.len()]) {
    let labels: Vec<&LabelBox> = frame.labels.iter().filter(|line| is_of(line, classes)).collect();
    let detections: Vec<&LabelBox> = frame.detections.iter().filter(|line| is_of(line, classes)).collect();
    let count = |corrected: &dyn Fn(&LabelBox) -> Box3| {
        let boxes: Vec<Box3> = detections.iter().map(|line| corrected(line)).collect();
        let hit = |label: &&&LabelBox| {
            let truth = forward_left_up(label, label_frame);
            boxes.iter().zip(&detections).any(|(b, line)| {
                let near = (0..2).all(|k| (b.center[k] - truth.center[k]).abs() < FAR_M);
                near && line.class.eq_ignore_ascii_case(&label.class) && iou_3d(b, &truth) > TRANSFORM_OVERLAP
            })
        };
        labels.iter().filter(hit).count()
    };
    let as_given = count(&|line| forward_left_up(line, label_frame));
    let corrected = BoxTransform::ALL.map(|transform| count(&|line| transform.apply(line, label_frame)));
    (labels.len(), as_given, corrected)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A line of a box given with axes forward, left, up.
    fn line(b: &Box3, label_frame: LabelFrame, score: Option<f32>) -> LabelBox {
        let mut line = LabelBox::from_box("Car", b, score);
        if label_frame == LabelFrame::Camera {
            let [x, y, z] = b.center;
            line.location = [-y, -(z - b.size[2] / 2.0), x];
            line.rotation_y = -(b.yaw_rad + FRAC_PI_2);
        }
        line
    }

    fn truth(i: usize) -> Vec<Box3> {
        let i = i as f64;
        vec![
            Box3::from_array([12.0 + i, 5.0 - 0.3 * i, -0.8, 4.2, 1.8, 1.5, 0.2 + 0.01 * i]),
            Box3::from_array([31.0 - i, -9.0 + 0.2 * i, -0.5, 4.6, 1.9, 1.6, -0.1 - 0.02 * i]),
        ]
    }

    fn frames(label_frame: LabelFrame, detection: impl Fn(&Box3) -> LabelBox) -> Vec<EvalFrame> {
        let of = |i: usize| EvalFrame {
            id: i.to_string(),
            labels: truth(i).iter().map(|b| line(b, label_frame, None)).collect(),
            detections: truth(i).iter().map(&detection).collect(),
        };
        (0..12).map(of).collect()
    }

    fn fit(label_frame: LabelFrame, detection: impl Fn(&Box3) -> LabelBox) -> TransformFit {
        TransformFit::of(&frames(label_frame, detection), label_frame, &["car".into()])
    }

    #[test]
    fn every_wrong_convention_is_named() {
        let half_turn =
            |b: &Box3| Box3 { center: [-b.center[0], -b.center[1], b.center[2]], yaw_rad: b.yaw_rad + PI, ..*b };
        for label_frame in [LabelFrame::Lidar, LabelFrame::Camera] {
            let own = |b: &Box3| line(b, label_frame, Some(0.9));
            let right = fit(label_frame, own);
            assert_eq!((right.labels, right.as_given, right.is_wrong()), (24, 24, false));
            type Wrong = fn(&Box3) -> Box3;
            let wrong: [(BoxTransform, Wrong); 7] = [
                (BoxTransform::MirrorY, |b| Box3 {
                    center: [b.center[0], -b.center[1], b.center[2]],
                    yaw_rad: -b.yaw_rad,
                    ..*b
                }),
                (BoxTransform::MirrorX, |b| Box3 {
                    center: [-b.center[0], b.center[1], b.center[2]],
                    yaw_rad: PI - b.yaw_rad,
                    ..*b
                }),
                (BoxTransform::TurnLeft, |b| Box3 {
                    center: [b.center[1], -b.center[0], b.center[2]],
                    yaw_rad: b.yaw_rad - FRAC_PI_2,
                    ..*b
                }),
                (BoxTransform::TurnRight, |b| Box3 {
                    center: [-b.center[1], b.center[0], b.center[2]],
                    yaw_rad: b.yaw_rad + FRAC_PI_2,
                    ..*b
                }),
                (BoxTransform::FromBottom, |b| Box3 {
                    center: [b.center[0], b.center[1], b.center[2] - b.size[2] / 2.0],
                    ..*b
                }),
                (BoxTransform::FromCentre, |b| Box3 {
                    center: [b.center[0], b.center[1], b.center[2] + b.size[2] / 2.0],
                    ..*b
                }),
                (BoxTransform::TurnBox, |b| Box3 { size: [b.size[1], b.size[0], b.size[2]], ..*b }),
            ];
            for (transform, spoil) in wrong {
                let found = fit(label_frame, |b| own(&spoil(b)));
                assert!(found.is_wrong() && found.best == (transform, 24), "{label_frame:?} {transform:?}: {found:?}");
            }
            let found = fit(label_frame, |b| own(&half_turn(b)));
            assert!(found.is_wrong() && found.best.0 == BoxTransform::TurnRound, "{found:?}");
            let found = fit(label_frame, |b| own(&Box3 { yaw_rad: -b.yaw_rad - FRAC_PI_2, ..*b }));
            // Of boxes along the x axis, both transforms are nearly the same.
            let is_yaw = matches!(found.best.0, BoxTransform::TurnBox | BoxTransform::MirrorYaw);
            assert!(found.is_wrong() && is_yaw, "{found:?}");
            let found = fit(label_frame, |b| line(b, other(label_frame), Some(0.9)));
            assert!(found.is_wrong() && found.best.0 == BoxTransform::OtherFrame, "{found:?}");
        }
    }

    #[test]
    fn a_detector_that_finds_nothing_is_not_blamed() {
        let far =
            fit(LabelFrame::Lidar, |b| line(&Box3 { center: [90.0, 90.0, 5.0], ..*b }, LabelFrame::Lidar, Some(0.1)));
        assert_eq!((far.as_given, far.best.1, far.is_wrong()), (0, 0, false));
        let none = TransformFit::of(&[], LabelFrame::Lidar, &["Car".into()]);
        assert!(!none.is_wrong() && none.labels == 0);
    }
}
