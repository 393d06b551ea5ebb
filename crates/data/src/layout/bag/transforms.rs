//! Poses by time, from `/tf`, `/tf_static` and odometry.

use super::cdr::Cdr;
use geometry::Pose;
use std::collections::BTreeMap;

/// Longest gap between two samples of a transform over which it is interpolated, ns.
const LONGEST_GAP_NS: i64 = 500_000_000;

/// Longest chain of frames.
const MOST_FRAMES: usize = 64;

/// A tree of frames.
#[derive(Default)]
pub(super) struct Transforms {
    /// By child: its parent, whether it never changes, and its poses in the parent by time.
    frames: BTreeMap<String, Frame>,
}

struct Frame {
    parent: String,
    fixed: bool,
    samples: BTreeMap<i64, Pose>,
}

impl Transforms {
    /// Adds a `tf2_msgs/msg/TFMessage`.
    pub fn add_tf(&mut self, message: &[u8], fixed: bool) -> Result<(), String> {
        let mut cdr = Cdr::new(message)?;
        for _ in 0..cdr.u32()? {
            let (header, child) = (cdr.header()?, cdr.string()?);
            self.add(header.frame, child, header.stamp_ns, cdr.pose()?, fixed);
        }
        Ok(())
    }

    /// Adds a `nav_msgs/msg/Odometry`.
    pub fn add_odometry(&mut self, message: &[u8]) -> Result<(), String> {
        let mut cdr = Cdr::new(message)?;
        let (header, child) = (cdr.header()?, cdr.string()?);
        self.add(header.frame, child, header.stamp_ns, cdr.pose()?, false);
        Ok(())
    }

    fn add(&mut self, parent: String, child: String, stamp_ns: i64, pose: Pose, fixed: bool) {
        let child = child.trim_start_matches('/').to_string();
        let new = || Frame { parent: parent.clone(), fixed, samples: BTreeMap::new() };
        let frame = self.frames.entry(child).or_insert_with(new);
        // A frame has one parent: the first that was seen.
        if frame.parent == parent {
            frame.samples.insert(stamp_ns, pose);
        }
    }

    /// Pose of a frame at a time in the frame at the root of the tree; `None` if nothing moves there, or in a gap.
    pub fn world_from(&self, frame: &str, stamp_ns: i64) -> Option<Pose> {
        let (mut at, mut pose, mut moves) = (frame, Pose::identity(), false);
        for _ in 0..MOST_FRAMES {
            let Some(link) = self.frames.get(at) else { return moves.then_some(pose) };
            pose = link.at(stamp_ns)? * pose;
            moves |= !link.fixed;
            at = &link.parent;
        }
        None
    }
}

impl Frame {
    fn at(&self, stamp_ns: i64) -> Option<Pose> {
        let before = self.samples.range(..=stamp_ns).next_back();
        let after = self.samples.range(stamp_ns..).next();
        if self.fixed {
            return before.or(after).map(|(_, pose)| *pose);
        }
        // Outside of the samples nothing is extrapolated.
        let ((t0, first), (t1, second)) = (before?, after?);
        let gap = t1 - t0;
        if gap > LONGEST_GAP_NS {
            return None;
        }
        if gap == 0 {
            return Some(*first);
        }
        first.try_lerp_slerp(second, (stamp_ns - t0) as f64 / gap as f64, 1e-9)
    }
}
