//! In which frame, and by which convention, are the labels written? The reading that puts the points into the boxes tells.
//!
//! Every label is read in all ways that are known to occur, and the points inside that stand above the ground are counted. The ground itself
//! does not count: it would fill any box that lies too low.

use super::ground::Ground;
use super::report::Findings;
use super::survey::FrameFacts;
use crate::{Calibration, Dataset, LabelBox, LabelFrame};
use geometry::Box3;
use serde::Serialize;
use std::f64::consts::FRAC_PI_2;

/// What the three numbers of the location are.
#[derive(Clone, Copy, PartialEq, Debug)]
enum Place {
    LidarCentre,
    LidarBottom,
    CameraBottom,
    CameraCentre,
}

/// What the rotation is.
#[derive(Clone, Copy, PartialEq, Debug)]
enum Turn {
    Yaw,
    MinusYaw,
    YawPlus90,
    MinusYawMinus90,
}

/// What the three sizes are.
#[derive(Clone, Copy, PartialEq, Debug)]
enum Sizes {
    HeightWidthLength,
    LengthWidthHeight,
}

const PLACES: [Place; 4] = [Place::LidarCentre, Place::LidarBottom, Place::CameraBottom, Place::CameraCentre];
const TURNS: [Turn; 4] = [Turn::Yaw, Turn::MinusYaw, Turn::YawPlus90, Turn::MinusYawMinus90];
const SIZES: [Sizes; 2] = [Sizes::HeightWidthLength, Sizes::LengthWidthHeight];
const READINGS: usize = PLACES.len() * TURNS.len() * SIZES.len();

/// Points above the ground inside one label's box, for each reading.
pub(super) type Evidence = [u32; READINGS];

/// A label needs as many points inside under some reading to have a say.
const FEWEST_POINTS: u32 = 5;
/// Labels farther away have too few points to tell, m.
const REACH_M: f64 = 70.0;
/// Two counts differ clearly if the smaller is below this part of the larger.
const CLEARLY_LESS: f64 = 0.85;

/// A way to read the labels, and how well it does.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Reading {
    /// In words.
    pub reading: String,
    /// It is the one that the data set declares.
    pub declared: bool,
    /// Points that it puts into a box, as a part of what the best reading of that label puts there; mean over the labels.
    pub share: f64,
}

fn all() -> impl Iterator<Item = (Place, Turn, Sizes)> {
    PLACES.into_iter().flat_map(|p| TURNS.into_iter().flat_map(move |t| SIZES.into_iter().map(move |s| (p, t, s))))
}

fn declared(label_frame: LabelFrame) -> usize {
    let wanted = match label_frame {
        LabelFrame::Lidar => (Place::LidarCentre, Turn::Yaw, Sizes::HeightWidthLength),
        LabelFrame::Camera => (Place::CameraBottom, Turn::MinusYawMinus90, Sizes::HeightWidthLength),
    };
    all().position(|reading| reading == wanted).expect("the declared readings are among all")
}

/// A label's box by one reading.
fn read(line: &LabelBox, (place, turn, sizes): (Place, Turn, Sizes), calibration: Option<&Calibration>) -> Box3 {
    let [a, b, c] = line.size_hwl;
    let size = match sizes {
        Sizes::HeightWidthLength => [c, b, a],
        Sizes::LengthWidthHeight => [a, b, c],
    };
    // Without a calibration the two frames are taken to differ by their axes alone.
    let lidar_point = |[x, y, z]: [f64; 3]| calibration.map_or([z, -x, -y], |c| c.lidar_point([x, y, z]));
    let mut center = match place {
        Place::LidarCentre | Place::LidarBottom => line.location,
        Place::CameraBottom | Place::CameraCentre => lidar_point(line.location),
    };
    if matches!(place, Place::LidarBottom | Place::CameraBottom) {
        center[2] += size[2] / 2.0;
    }
    let yaw_rad = match turn {
        Turn::Yaw => line.rotation_y,
        Turn::MinusYaw => -line.rotation_y,
        Turn::YawPlus90 => line.rotation_y + FRAC_PI_2,
        Turn::MinusYawMinus90 => -line.rotation_y - FRAC_PI_2,
    };
    Box3 { center, size, yaw_rad }
}

pub(super) fn evidence(dataset: &Dataset, id: &str, lines: &[LabelBox], ground: &Ground) -> Vec<Evidence> {
    let calibration = dataset.calibration(id).ok();
    let lines = lines.iter().filter(|line| !line.is_dont_care() && line.has_box());
    let count = |line: &LabelBox| -> Evidence {
        let mut counts = [0; READINGS];
        for (count, reading) in counts.iter_mut().zip(all()) {
            let bbox = read(line, reading, calibration.as_ref());
            let [x, y, _] = bbox.center;
            if x.hypot(y) < REACH_M && bbox.size.iter().all(|s| *s < 40.0) {
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

/// Compares the readings. `&[FrameFacts]` must come from frames that were read in all ways.
pub(super) fn judge(dataset: &Dataset, frames: &[FrameFacts], findings: &mut Findings) -> Vec<Reading> {
    let evidence = frames.iter().flat_map(|f| &f.evidence).filter(|e| e.iter().any(|n| *n >= FEWEST_POINTS));
    let evidence: Vec<&Evidence> = evidence.collect();
    if evidence.is_empty() {
        if frames.iter().any(|f| !f.evidence.is_empty()) {
            let message = "no reading of the labels puts points into the boxes: label frame and heading stay unknown";
            findings.problem("label frame", message.into(), []);
        }
        return Vec::new();
    }
    let share = |r: usize| {
        let part = |e: &&Evidence| f64::from(e[r]) / f64::from(*e.iter().max().expect("there are readings"));
        evidence.iter().map(part).sum::<f64>() / evidence.len() as f64
    };
    let shares: Vec<f64> = (0..READINGS).map(share).collect();
    let here = declared(dataset.config.label_frame);
    // The first one wins a tie, so that a reading which says the same is not preferred to the declared one.
    let mut order: Vec<usize> = (0..READINGS).collect();
    order.sort_by(|a, b| shares[*b].total_cmp(&shares[*a]).then((*a != here).cmp(&(*b != here))).then(a.cmp(b)));
    let best = order[0];
    let clearly = |more: usize, less: usize| {
        let wins = |e: &&&Evidence| e[more] >= FEWEST_POINTS && f64::from(e[less]) < CLEARLY_LESS * f64::from(e[more]);
        evidence.iter().filter(wins).count()
    };
    let (better, worse) = (clearly(best, here), clearly(here, best));
    let words = |r: usize| describe(all().nth(r).expect("it is one of all"), dataset.config.label_frame);
    if shares[best] - shares[here] > 0.08 && better >= 2.max(3 * worse) {
        let message = format!(
            "label_frame = {:?} puts {:.0} % of the points into the boxes that the best reading puts there ({:.0} %): {}; {better} of {} labels \
             speak for it, {worse} against",
            format!("{:?}", dataset.config.label_frame).to_lowercase(),
            shares[here] * 100.0,
            shares[best] * 100.0,
            words(best),
            evidence.len()
        );
        findings.problem("label frame", message, []);
    }
    let reading = |r: usize| Reading { reading: words(r), declared: r == here, share: shares[r] };
    order.into_iter().filter(|r| shares[*r] > 0.0).map(reading).collect()
}

fn describe((place, turn, sizes): (Place, Turn, Sizes), label_frame: LabelFrame) -> String {
    let place = match place {
        Place::LidarCentre => "location is the centre of the box in the cloud's frame",
        Place::LidarBottom => "location is the centre of the box's bottom in the cloud's frame",
        Place::CameraBottom => "location is the centre of the box's bottom in the camera's frame",
        Place::CameraCentre => "location is the centre of the box in the camera's frame",
    };
    let turn = match (turn, label_frame) {
        (Turn::Yaw, _) => "rotation is the yaw, counter-clockwise from +x",
        (Turn::MinusYaw, _) => "rotation is the yaw, but clockwise",
        (Turn::YawPlus90, LabelFrame::Lidar) => "rotation is the yaw less 90 degrees (or length and width are swapped)",
        (Turn::YawPlus90, LabelFrame::Camera) => "rotation is KITTI's, but with the other sign",
        (Turn::MinusYawMinus90, _) => "rotation is KITTI's, about the camera's y axis",
    };
    let sizes = match sizes {
        Sizes::HeightWidthLength => "sizes are height, width, length",
        Sizes::LengthWidthHeight => "sizes are length, width, height",
    };
    format!("{place}, {turn}, {sizes}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_declared_readings_are_what_the_data_set_reads() {
        let calibration = Calibration::parse(crate::calibration::tests::MADE_UP, std::path::Path::new("c")).unwrap();
        let bbox = Box3::from_array([20.0, 3.0, -1.0, 4.0, 1.8, 1.5, 0.4]);
        let readings: Vec<_> = all().collect();
        let lidar = LabelBox::from_box("Car", &bbox, None);
        assert_eq!(read(&lidar, readings[declared(LabelFrame::Lidar)], None), bbox);
        let camera = calibration.camera_from_lidar_box("Car", &bbox, None, [1242, 375]);
        let again = read(&camera, readings[declared(LabelFrame::Camera)], Some(&calibration));
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
