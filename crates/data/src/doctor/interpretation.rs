//! Checks in which frame and by which convention the labels are written.
//!
//! Every label is interpreted in all conventions that are known to occur, and the points above the ground inside its
//! box are counted. The interpretation with most points inside is the best. Points on the ground are not counted,
//! because they would fill every box that is too low.

use super::ground::Ground;
use super::report::Findings;
use super::survey::FrameFacts;
use crate::{Calibration, Dataset, LabelBox, LabelFrame};
use geometry::Box3;
use schemars::JsonSchema;
use serde::Serialize;
use std::f64::consts::FRAC_PI_2;

/// Meaning of the three numbers of the location.
#[derive(Clone, Copy, PartialEq, Debug)]
enum Location {
    LidarCentre,
    LidarBottom,
    CameraBottom,
    CameraCentre,
}

/// Meaning of the rotation.
#[derive(Clone, Copy, PartialEq, Debug)]
enum Rotation {
    Yaw,
    MinusYaw,
    YawPlus90,
    MinusYawMinus90,
}

/// Order of the three sizes.
#[derive(Clone, Copy, PartialEq, Debug)]
enum Sizes {
    HeightWidthLength,
    LengthWidthHeight,
}

const LOCATIONS: [Location; 4] =
    [Location::LidarCentre, Location::LidarBottom, Location::CameraBottom, Location::CameraCentre];
const ROTATIONS: [Rotation; 4] = [Rotation::Yaw, Rotation::MinusYaw, Rotation::YawPlus90, Rotation::MinusYawMinus90];
const SIZES: [Sizes; 2] = [Sizes::HeightWidthLength, Sizes::LengthWidthHeight];
/// Number of interpretations.
const INTERPRETATIONS: usize = LOCATIONS.len() * ROTATIONS.len() * SIZES.len();

/// Number of points above the ground inside one label's box, for each interpretation.
pub(super) type InsideCounts = [u32; INTERPRETATIONS];

/// A label is used if it has at least this many points inside under some interpretation.
const MIN_POINTS: u32 = 5;
/// Largest distance of a label that is used, m. Farther labels have too few points.
const MAX_DISTANCE_M: f64 = 70.0;
/// Two counts differ clearly if the smaller is below this fraction of the larger.
const CLEAR_RATIO: f64 = 0.85;

/// An interpretation of the labels and how well it agrees with the points.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct Interpretation {
    /// Meaning of location, rotation and sizes, as text.
    pub reading: String,
    /// Whether it is the interpretation that the data set declares.
    pub declared: bool,
    /// Points inside a box, relative to the best interpretation of the same label; mean over the labels.
    pub share: f64,
}

/// All interpretations. The index of [`InsideCounts`] is the position in this order.
fn all() -> impl Iterator<Item = (Location, Rotation, Sizes)> {
    LOCATIONS
        .into_iter()
        .flat_map(|p| ROTATIONS.into_iter().flat_map(move |t| SIZES.into_iter().map(move |s| (p, t, s))))
}

/// Index of the interpretation that a label frame declares.
fn declared(label_frame: LabelFrame) -> usize {
    let wanted = match label_frame {
        LabelFrame::Lidar => (Location::LidarCentre, Rotation::Yaw, Sizes::HeightWidthLength),
        LabelFrame::Camera => (Location::CameraBottom, Rotation::MinusYawMinus90, Sizes::HeightWidthLength),
    };
    all().position(|i| i == wanted).expect("all() has the declared interpretations")
}

/// The box of a label, LiDAR frame, by one interpretation.
fn interpret(
    line: &LabelBox,
    (location, rotation, sizes): (Location, Rotation, Sizes),
    calibration: Option<&Calibration>,
) -> Box3 {
    let [a, b, c] = line.size_hwl;
    let size = match sizes {
        Sizes::HeightWidthLength => [c, b, a],
        Sizes::LengthWidthHeight => [a, b, c],
    };
    // Without a calibration the two frames are assumed to differ by their axes only.
    let lidar_point = |[x, y, z]: [f64; 3]| calibration.map_or([z, -x, -y], |c| c.lidar_point([x, y, z]));
    let mut center = match location {
        Location::LidarCentre | Location::LidarBottom => line.location,
        Location::CameraBottom | Location::CameraCentre => lidar_point(line.location),
    };
    if matches!(location, Location::LidarBottom | Location::CameraBottom) {
        center[2] += size[2] / 2.0;
    }
    let yaw_rad = match rotation {
        Rotation::Yaw => line.rotation_y,
        Rotation::MinusYaw => -line.rotation_y,
        Rotation::YawPlus90 => line.rotation_y + FRAC_PI_2,
        Rotation::MinusYawMinus90 => -line.rotation_y - FRAC_PI_2,
    };
    Box3 { center, size, yaw_rad }
}

/// Points inside each label of a frame, for all interpretations. DontCare and labels without a 3D box are left out.
pub(super) fn inside_counts(dataset: &Dataset, id: &str, lines: &[LabelBox], ground: &Ground) -> Vec<InsideCounts> {
    let calibration = dataset.calibration(id).ok();
    let lines = lines.iter().filter(|line| !line.is_dont_care() && line.has_box());
    let count = |line: &LabelBox| -> InsideCounts {
        let mut counts = [0; INTERPRETATIONS];
        for (count, interpretation) in counts.iter_mut().zip(all()) {
            let bbox = interpret(line, interpretation, calibration.as_ref());
            let [x, y, _] = bbox.center;
            if x.hypot(y) < MAX_DISTANCE_M && bbox.size.iter().all(|s| *s < 40.0) {
                let half = bbox.size.map(|s| s / 2.0);
                let inside = |p: &&[f64; 3]| {
                    let local = bbox.to_local(**p);
                    (0..3).all(|i| local[i].abs() <= half[i])
                };
                *count = ground.standing_near(x, y, half[0].hypot(half[1])).filter(inside).count() as u32;
            }
        }
        counts
    };
    lines.map(count).collect()
}

/// Compares the interpretations on the frames that have counts. Best first; interpretations without points are left
/// out.
pub(super) fn compare(dataset: &Dataset, frames: &[FrameFacts], findings: &mut Findings) -> Vec<Interpretation> {
    let labels = frames.iter().flat_map(|f| &f.inside_counts).filter(|l| l.iter().any(|n| *n >= MIN_POINTS));
    let labels: Vec<&InsideCounts> = labels.collect();
    if labels.is_empty() {
        if frames.iter().any(|f| !f.inside_counts.is_empty()) {
            let message =
                "no known convention of the labels has points inside the boxes: label frame and heading are unknown";
            findings.problem("label frame", message.into(), []);
        }
        return Vec::new();
    }
    let share = |r: usize| {
        let part = |l: &&InsideCounts| f64::from(l[r]) / f64::from(*l.iter().max().expect("the counts are not empty"));
        labels.iter().map(part).sum::<f64>() / labels.len() as f64
    };
    let shares: Vec<f64> = (0..INTERPRETATIONS).map(share).collect();
    let declared = declared(dataset.config.label_frame);
    // In a tie the declared interpretation comes first.
    let mut order: Vec<usize> = (0..INTERPRETATIONS).collect();
    order
        .sort_by(|a, b| shares[*b].total_cmp(&shares[*a]).then((*a != declared).cmp(&(*b != declared))).then(a.cmp(b)));
    let best = order[0];
    let clearly = |more: usize, less: usize| {
        let wins = |l: &&&InsideCounts| l[more] >= MIN_POINTS && f64::from(l[less]) < CLEAR_RATIO * f64::from(l[more]);
        labels.iter().filter(wins).count()
    };
    let (better, worse) = (clearly(best, declared), clearly(declared, best));
    let description = |r: usize| {
        describe(all().nth(r).expect("the index is below the number of interpretations"), dataset.config.label_frame)
    };
    if shares[best] - shares[declared] > 0.08 && better >= 2.max(3 * worse) {
        let message = format!(
            "label_frame = {:?} has {:.0} % of a label's points inside the boxes, another convention has {:.0} %: {}; \
             {better} of {} labels fit it clearly better, {worse} clearly worse",
            format!("{:?}", dataset.config.label_frame).to_lowercase(),
            shares[declared] * 100.0,
            shares[best] * 100.0,
            description(best),
            labels.len()
        );
        findings.problem("label frame", message, []);
    }
    let interpretation =
        |r: usize| Interpretation { reading: description(r), declared: r == declared, share: shares[r] };
    order.into_iter().filter(|r| shares[*r] > 0.0).map(interpretation).collect()
}

fn describe((location, rotation, sizes): (Location, Rotation, Sizes), label_frame: LabelFrame) -> String {
    let location = match location {
        Location::LidarCentre => "location is the centre of the box in the cloud's frame",
        Location::LidarBottom => "location is the centre of the box's bottom in the cloud's frame",
        Location::CameraBottom => "location is the centre of the box's bottom in the camera's frame",
        Location::CameraCentre => "location is the centre of the box in the camera's frame",
    };
    let rotation = match (rotation, label_frame) {
        (Rotation::Yaw, _) => "rotation is the yaw, counter-clockwise from +x",
        (Rotation::MinusYaw, _) => "rotation is the yaw, but clockwise",
        (Rotation::YawPlus90, LabelFrame::Lidar) => {
            "rotation is the yaw less 90 degrees (or length and width are swapped)"
        }
        (Rotation::YawPlus90, LabelFrame::Camera) => "rotation is KITTI's, but with the other sign",
        (Rotation::MinusYawMinus90, _) => "rotation is KITTI's, about the camera's y axis",
    };
    let sizes = match sizes {
        Sizes::HeightWidthLength => "sizes are height, width, length",
        Sizes::LengthWidthHeight => "sizes are length, width, height",
    };
    format!("{location}, {rotation}, {sizes}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn declared_interpretations_match_the_data_set() {
        let calibration = Calibration::parse(crate::calibration::tests::MADE_UP, std::path::Path::new("c")).unwrap();
        let bbox = Box3::from_array([20.0, 3.0, -1.0, 4.0, 1.8, 1.5, 0.4]);
        let interpretations: Vec<_> = all().collect();
        let lidar = LabelBox::from_box("Car", &bbox, None);
        assert_eq!(interpret(&lidar, interpretations[declared(LabelFrame::Lidar)], None), bbox);
        let camera = calibration.camera_from_lidar_box("Car", &bbox, None, [1242, 375]);
        let again = interpret(&camera, interpretations[declared(LabelFrame::Camera)], Some(&calibration));
        let off = again
            .with_wrapped_yaw()
            .to_array()
            .iter()
            .zip(bbox.to_array())
            .map(|(a, b)| (a - b).abs())
            .fold(0.0, f64::max);
        assert!(off < 1e-9, "{again:?}");
    }
}
