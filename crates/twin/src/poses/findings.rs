//! What is wrong with stamps and poses, without a look at the clouds.

use data::Moment;
use data::layout::StampUnit;
use std::fmt;

/// Speed that no road vehicle has, m/s.
const MOST_SPEED_M_S: f64 = 90.0;

/// Turn rate that no road vehicle has, rad/s.
const MOST_TURN_RAD_S: f64 = 3.0;

/// A step between stamps is a gap from this multiple of the median on.
const GAP_STEPS: f64 = 2.5;

/// A vehicle that stays within this distance stands, m.
const STANDING_M: f64 = 0.5;

/// Something about the stamps or poses of a recording that a user has to know. Frames are named by their ids.
#[derive(Clone, Debug, PartialEq)]
pub enum PoseFinding {
    /// The stamps are in another unit than seconds.
    StampUnit {
        /// Median step between stamps.
        step: f64,
        /// The unit in which the step is that of a scan.
        unit: StampUnit,
    },
    /// The vehicle stays at one place.
    Standing {
        /// Largest distance of a pose from the first one, m.
        extent_m: f64,
    },
    /// A frame is earlier than the one before it.
    OutOfOrder {
        /// The frame.
        frame: String,
        /// The frame before it in the recording.
        after: String,
    },
    /// Two frames in a row have the same stamp, or, without stamps, the same pose.
    Twice {
        /// The second of the frames.
        frame: String,
        /// The first of the frames.
        other: String,
    },
    /// Frames are missing between two others.
    MissingFrames {
        /// The last frame before the gap.
        before: String,
        /// The first frame after the gap.
        after: String,
        /// Length of the gap, s.
        gap_s: f64,
    },
    /// Frames in a row have no pose: a gap of the GPS.
    NoPose {
        /// The first frame without a pose.
        first: String,
        /// The last frame without a pose.
        last: String,
        /// Number of frames.
        frames: usize,
    },
    /// A pose is not finite.
    NotFinite {
        /// The frame.
        frame: String,
    },
    /// Two poses in a row are farther apart than a vehicle can move.
    Jump {
        /// The second frame.
        frame: String,
        /// Speed from the frame before it, m/s.
        speed_m_s: f64,
        /// Turn rate from the frame before it, rad/s.
        turn_rad_s: f64,
    },
}

impl fmt::Display for PoseFinding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            PoseFinding::StampUnit { step, unit } => {
                let unit = match unit {
                    StampUnit::Seconds => "s",
                    StampUnit::Milliseconds => "ms",
                    StampUnit::Microseconds => "us",
                    StampUnit::Nanoseconds => "ns",
                };
                write!(f, "the median step between time stamps is {step}: they seem to be in {unit}; give them in s")
            }
            PoseFinding::Standing { extent_m } => write!(
                f,
                "the vehicle stays within {extent_m:.2} m: the map shows one place from one side, and neither the poses \
                 nor range errors of the sensor can be checked"
            ),
            PoseFinding::OutOfOrder { frame, after } => {
                write!(f, "frame {frame} is earlier than frame {after}, which is before it; sort the frames by time")
            }
            PoseFinding::Twice { frame, other } => {
                write!(f, "frame {frame} is frame {other} again: the same time stamp or the same pose; remove one")
            }
            PoseFinding::MissingFrames { before, after, gap_s } => {
                write!(f, "between the frames {before} and {after} there are {gap_s:.2} s without a frame")
            }
            PoseFinding::NoPose { first, last, frames } => {
                write!(f, "{frames} frames from {first} to {last} have no pose")
            }
            PoseFinding::NotFinite { frame } => {
                write!(f, "the pose of frame {frame} is not finite; leave the frame out or use the odometry")
            }
            PoseFinding::Jump { frame, speed_m_s, turn_rad_s } => write!(
                f,
                "before frame {frame} the vehicle moves at {speed_m_s:.0} m/s and turns by {turn_rad_s:.1} rad/s: the \
                 frames are not in order, the stamps are in another unit, angles are in degrees, or the recording was \
                 cut"
            ),
        }
    }
}

/// Checks stamps and poses of the frames of a recording, in the order in which they are given. Findings about the whole
/// recording come first, the others in the order of the frames.
pub fn check_moments(moments: &[Moment]) -> Vec<PoseFinding> {
    let mut findings = Vec::new();
    let step_s = check_whole(moments, &mut findings);
    // Without any pose there is no gap: the recording has none.
    let known = moments.iter().any(|moment| moment.world_from_lidar.is_some());
    let mut gap = 0;
    for (i, moment) in moments.iter().enumerate() {
        if i > 0 {
            check_pair(&moments[i - 1], moment, step_s, &mut findings);
        }
        if let Some(pose) = &moment.world_from_lidar {
            if !is_finite(pose) {
                findings.push(PoseFinding::NotFinite { frame: moment.id.clone() });
            }
            gap = 0;
            continue;
        }
        gap += 1;
        let ends = moments.get(i + 1).is_none_or(|next| next.world_from_lidar.is_some());
        if known && ends {
            let (first, last) = (moments[i + 1 - gap].id.clone(), moment.id.clone());
            findings.push(PoseFinding::NoPose { first, last, frames: gap });
        }
    }
    findings
}

fn is_finite(pose: &geometry::Pose) -> bool {
    pose.translation.vector.iter().chain(pose.rotation.coords.iter()).all(|v| v.is_finite())
}

/// Checks that need the whole recording. Returns the median step between stamps, s, if it is that of a scan.
fn check_whole(moments: &[Moment], findings: &mut Vec<PoseFinding>) -> Option<f64> {
    let stamps: Vec<f64> = moments.iter().filter_map(|moment| moment.stamp_s).collect();
    let steps = stamps.windows(2).map(|pair| (pair[1] - pair[0]).abs()).collect();
    let step = statistics::median_upper::<f64>(steps);
    let unit = step.and_then(StampUnit::of_step);
    if let (Some(step), Some(unit)) = (step, unit.filter(|unit| *unit != StampUnit::Seconds)) {
        findings.push(PoseFinding::StampUnit { step, unit });
    }
    let poses = moments.iter().filter_map(|moment| moment.world_from_lidar).filter(is_finite);
    let places: Vec<_> = poses.map(|pose| pose.translation.vector).collect();
    if let [first, _, ..] = &places[..] {
        let extent_m = places.iter().map(|place| (place - first).norm()).fold(0.0, f64::max);
        if extent_m < STANDING_M {
            findings.push(PoseFinding::Standing { extent_m });
        }
    }
    step.filter(|_| unit == Some(StampUnit::Seconds))
}

fn check_pair(before: &Moment, moment: &Moment, step_s: Option<f64>, findings: &mut Vec<PoseFinding>) {
    let passed_s = before.stamp_s.zip(moment.stamp_s).map(|(a, b)| b - a);
    let poses = before.world_from_lidar.zip(moment.world_from_lidar);
    let same_pose = poses.is_some_and(|(a, b)| a == b);
    if passed_s == Some(0.0) || (passed_s.is_none() && same_pose) {
        findings.push(PoseFinding::Twice { frame: moment.id.clone(), other: before.id.clone() });
        return;
    }
    if passed_s.is_some_and(|passed_s| passed_s < 0.0) {
        findings.push(PoseFinding::OutOfOrder { frame: moment.id.clone(), after: before.id.clone() });
        return;
    }
    if let Some((gap_s, _)) = passed_s.zip(step_s).filter(|(passed_s, step_s)| *passed_s > GAP_STEPS * step_s) {
        findings.push(PoseFinding::MissingFrames { before: before.id.clone(), after: moment.id.clone(), gap_s });
    }
    // Without usable stamps, 10 Hz.
    let passed_s = passed_s.filter(|_| step_s.is_some()).unwrap_or(0.1);
    if let Some((a, b)) = poses {
        let step = a.inverse() * b;
        let (speed_m_s, turn_rad_s) = (step.translation.vector.norm() / passed_s, step.rotation.angle() / passed_s);
        if speed_m_s > MOST_SPEED_M_S || turn_rad_s > MOST_TURN_RAD_S {
            findings.push(PoseFinding::Jump { frame: moment.id.clone(), speed_m_s, turn_rad_s });
        }
    }
}

/// The places of the frames in the order of their stamps, each stamp once: of frames with the same stamp the first one.
/// A frame without a stamp stays behind the frame before it.
pub fn in_order(moments: &[Moment]) -> Vec<usize> {
    let mut last = f64::NEG_INFINITY;
    let mut keyed: Vec<(f64, bool, usize)> = Vec::with_capacity(moments.len());
    for (i, moment) in moments.iter().enumerate() {
        last = moment.stamp_s.unwrap_or(last);
        keyed.push((last, moment.stamp_s.is_some(), i));
    }
    keyed.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.2.cmp(&b.2)));
    let mut seen = None;
    keyed.retain(|(stamp, known, _)| !*known || seen.replace(*stamp) != Some(*stamp));
    keyed.into_iter().map(|(_, _, i)| i).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use geometry::{Pose, upright_pose};
    use proptest::prelude::*;

    /// A drive at 10 m/s and 10 Hz.
    fn drive(frames: usize) -> Vec<Moment> {
        let moment = |i: usize| Moment {
            stamp_s: Some(0.1 * i as f64),
            world_from_lidar: Some(upright_pose([i as f64, 0.0, 1.7], 0.01 * i as f64)),
            ..Moment::of(&format!("{i:06}"))
        };
        (0..frames).map(moment).collect()
    }

    #[test]
    fn a_good_drive_has_no_findings() {
        assert_eq!(check_moments(&drive(20)), []);
        assert_eq!(check_moments(&drive(1)), []);
        assert_eq!(check_moments(&[]), []);
        let bare: Vec<Moment> = drive(5).iter().map(|moment| Moment::of(&moment.id)).collect();
        assert_eq!(check_moments(&bare), []);
    }

    /// Changes every moment, by its number.
    fn each(moments: &mut [Moment], change: impl Fn(usize, &mut Moment)) {
        moments.iter_mut().enumerate().for_each(|(i, moment)| change(i, moment));
    }

    #[test]
    fn each_fault_is_named() {
        type Fault = (&'static str, fn(&mut Vec<Moment>), &'static [&'static str]);
        let faults: [Fault; 11] = [
            ("ms", |m| each(m, |i, m| m.stamp_s = Some(100.0 * i as f64)), &["they seem to be in ms"]),
            ("ns", |m| each(m, |i, m| m.stamp_s = Some(1e8 * i as f64)), &["they seem to be in ns"]),
            ("swapped", |m| m.swap(4, 5), &["frame 000004 is earlier than frame 000005"]),
            ("twice", |m| m.insert(5, m[4].clone()), &["frame 000004 is frame 000004 again"]),
            ("missing", |m| drop(m.drain(5..9)), &["between the frames 000004 and 000009 there are 0.50 s"]),
            ("gap", |m| each(&mut m[5..8], |_, m| m.world_from_lidar = None), &["3 frames from 000005 to 000007"]),
            ("end", |m| each(&mut m[18..], |_, m| m.world_from_lidar = None), &["2 frames from 000018 to 000019"]),
            (
                "nan",
                |m| m[5].world_from_lidar = Some(Pose::translation(f64::NAN, 0.0, 0.0)),
                &["the pose of frame 000005 is not finite"],
            ),
            (
                "degrees",
                |m| each(m, |i, m| m.world_from_lidar = Some(upright_pose([i as f64, 0.0, 1.7], 0.573 * i as f64))),
                &["turns by 5.7 rad/s"; 19],
            ),
            (
                "cut",
                |m| each(&mut m[9..], |i, m| m.world_from_lidar = Some(Pose::translation(100.0 + i as f64, 0.0, 0.0))),
                &["before frame 000009 the vehicle moves at 920 m/s"],
            ),
            (
                "standing",
                |m| each(m, |_, m| m.world_from_lidar = Some(upright_pose([3.0, 0.0, 1.7], 0.1))),
                &["the vehicle stays within 0.00 m"],
            ),
        ];
        for (name, fault, want) in faults {
            let mut moments = drive(20);
            fault(&mut moments);
            let found: Vec<String> = check_moments(&moments).iter().map(PoseFinding::to_string).collect();
            // Behind swapped frames there is a gap as well: only the first finding counts.
            let found = if name == "swapped" { &found[..1] } else { &found[..] };
            assert_eq!(found.len(), want.len(), "{name}: {found:?}");
            for (found, want) in found.iter().zip(want) {
                assert!(found.contains(want), "{name}: {found}, not {want}");
            }
        }
    }

    proptest! {
        #[test]
        fn frames_are_put_in_order_and_once(
            order in Just((0..12usize).collect::<Vec<_>>()).prop_shuffle(),
            again in 0..12usize,
        ) {
            let drive = drive(12);
            let mut moments: Vec<Moment> = order.iter().map(|i| drive[*i].clone()).collect();
            moments.push(drive[again].clone());
            let ids: Vec<&str> = in_order(&moments).into_iter().map(|i| moments[i].id.as_str()).collect();
            prop_assert_eq!(ids, drive.iter().map(|m| m.id.as_str()).collect::<Vec<_>>());
            let bare: Vec<Moment> = drive.iter().map(|m| Moment::of(&m.id)).collect();
            prop_assert_eq!(in_order(&bare), (0..12).collect::<Vec<_>>());
        }
    }
}
