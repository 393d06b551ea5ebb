//! Offsets of groups of rays: rows of a sensor, strips of azimuth, or steps of range. Each group has one range offset,
//! and rows have one elevation offset as well. The pose error of each frame is subtracted before.

use super::mean::{KINDS, usable, weight};
use super::own_poses::{Mount, OwnPoses, off_surface_m};
use crate::catalogue::Covariate;
use crate::pairing::{FramePair, Ray};
use nalgebra::{UnitQuaternion, Vector3};
use rayon::prelude::*;
use sensor::Rig;
use std::collections::BTreeMap;
use std::ops::Range;

/// How rays are grouped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Grouping {
    /// Rows of each sensor.
    Row,
    /// Strips of azimuth of each sensor.
    Azimuth,
    /// Steps of range of each sensor.
    Range,
}

impl Grouping {
    /// What rays are grouped by, as findings name it.
    pub fn name(self) -> &'static str {
        Covariate::from(self).name()
    }

    /// Width of a group, in the unit of [`Group::place`].
    pub fn width(self) -> f64 {
        match self {
            Grouping::Row => 1.0,
            Grouping::Azimuth => STRIP_RAD,
            Grouping::Range => STEP_M,
        }
    }

    /// Where a ray lies among the groups, in the unit of [`Group::place`].
    pub fn place_of(self, ray: &Ray) -> f64 {
        match self {
            Grouping::Row => f64::from(ray.row),
            Grouping::Azimuth => f64::from(ray.azimuth_rad),
            Grouping::Range => ray.recorded_range_m(),
        }
    }

    /// Largest number of groups of a sensor.
    fn most(self) -> usize {
        match self {
            Grouping::Row => ROWS,
            Grouping::Azimuth => STRIPS,
            Grouping::Range => STEPS,
        }
    }
}

/// Width of a strip of azimuth, rad: 5 degrees.
const STRIP_RAD: f64 = 0.0873;

/// Strips of a full turn.
const STRIPS: usize = 72;

/// Step of range, m.
const STEP_M: f64 = 0.25;

/// Steps of range: up to 64 m.
const STEPS: usize = 256;

/// Largest number of rows of a sensor.
const ROWS: usize = 256;

/// A group of rays of one sensor.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Group {
    /// Number of the sensor.
    pub sensor: u8,
    /// Number of the row or strip.
    pub index: u16,
}

impl Group {
    /// The groups of the same sensor up to `reach` places away, itself among them.
    pub fn around(self, reach: u16) -> std::ops::RangeInclusive<Group> {
        let at = |index| Group { index, ..self };
        at(self.index.saturating_sub(reach))..=at(self.index + reach)
    }

    /// The group before it.
    pub fn previous(self) -> Option<Group> {
        Some(Group { index: self.index.checked_sub(1)?, ..self })
    }

    /// The group after it.
    pub fn next(self) -> Group {
        Group { index: self.index + 1, ..self }
    }

    /// The number of the row, the middle azimuth of the strip in rad, or the middle range of the step in m.
    pub fn place(self, grouping: Grouping) -> f64 {
        match grouping {
            Grouping::Row => f64::from(self.index),
            Grouping::Azimuth => (f64::from(self.index) + 0.5) * STRIP_RAD - std::f64::consts::PI,
            Grouping::Range => (f64::from(self.index) + 0.5) * STEP_M,
        }
    }
}

/// The group of a ray; `None` where its row is not known, and beyond the last step of range.
pub fn group_of(ray: &Ray, grouping: Grouping) -> Option<Group> {
    let index = match grouping {
        Grouping::Row => Some(ray.row).filter(|row| usize::from(*row) < ROWS)?,
        Grouping::Azimuth => {
            let strip = ((f64::from(ray.azimuth_rad) + std::f64::consts::PI) / STRIP_RAD).floor() as usize;
            strip.min(STRIPS - 1) as u16
        }
        Grouping::Range => Some((ray.recorded_range_m() / STEP_M) as u16).filter(|step| usize::from(*step) < STEPS)?,
    };
    Some(Group { sensor: ray.sensor, index })
}

/// Sums of one group of one frame, over an offset of range (m) and one of elevation (rad).
#[derive(Clone, Copy, Debug, Default)]
pub struct GroupSums {
    /// Squares and product of the two columns.
    pub gram: [f64; 3],
    /// Their products with the distance.
    pub right: [f64; 2],
    /// Rays.
    pub n: f64,
    /// Sum of the weights, where the squares of a column are divided by it to get its mean squared lever.
    pub weight: f64,
}

impl GroupSums {
    /// Adds another sum.
    pub fn merge(&mut self, other: &GroupSums) {
        (0..3).for_each(|k| self.gram[k] += other.gram[k]);
        (0..2).for_each(|k| self.right[k] += other.right[k]);
        self.n += other.n;
        self.weight += other.weight;
    }

    /// Subtracts a common level from the offset of one of the columns.
    pub fn lower(&mut self, column: usize, level: f64) {
        self.right[column] -= level * self.gram[2 * column];
    }

    /// Estimated offset of one of the columns, with a prior precision.
    pub fn offset(&self, column: usize, precision: f64) -> f64 {
        self.right[column] / (self.gram[2 * column] + precision)
    }

    /// Gain of a group by an offset, nats.
    pub fn gain(&self, column: usize, offset: f64) -> f64 {
        offset * self.right[column] - 0.5 * offset * offset * self.gram[2 * column]
    }
}

/// Groups of one frame, in their order.
pub type GroupFrame = Vec<(Group, GroupSums)>;

/// Number of parts of a group.
pub const PARTS: usize = 4;

/// Groups of one frame by part: rows and steps of range by quarters of the field of view, strips of azimuth by bands of
/// elevation.
pub type PartedFrame = [GroupFrame; PARTS];

/// Part of a ray within its group.
pub fn part_of(ray: &Ray, grouping: Grouping, half_fov_rad: f64) -> usize {
    let at = match grouping {
        Grouping::Row | Grouping::Range => f64::from(ray.azimuth_rad) / (2.0 * half_fov_rad) + 0.5,
        // Bands with about as many rays each for a sensor on a vehicle: edges at -10, -5 and -1 degrees.
        Grouping::Azimuth => {
            let below = [-0.175, -0.087, -0.017].iter().filter(|edge| f64::from(ray.elevation_rad) > **edge).count();
            (below as f64 + 0.5) / PARTS as f64
        }
    };
    ((at * PARTS as f64).floor().max(0.0) as usize).min(PARTS - 1)
}

/// Derivative of the distance across the surface by the row's elevation, m/rad.
pub fn elevation_lever(ray: &Ray, sensor_turn: &UnitQuaternion<f64>) -> f64 {
    let (az, el) = (f64::from(ray.azimuth_rad), f64::from(ray.elevation_rad));
    let up = sensor_turn * Vector3::new(-el.sin() * az.cos(), -el.sin() * az.sin(), el.cos());
    // The beam was sent higher by this angle.
    -ray.normal_vector().dot(&up) * ray.recorded_range_m()
}

/// Offsets of rows that were undone before frames were paired: of the range, m, and of the elevation, rad.
pub type Undone = BTreeMap<Group, [f64; 2]>;

/// Where surfaces are seen but for the offsets that are fitted.
#[derive(Clone, Copy)]
pub struct Seen<'a> {
    /// Pose of each frame as each sensor sees it.
    pub poses: &'a [OwnPoses],
    /// Offset of each kind of surface, m.
    pub structure: [f64; KINDS],
    /// Offsets of rows that were undone. They are added to what is left: the fit is of the whole offsets, with the
    /// levers of the place where the rows were moved to.
    pub undone: &'a Undone,
}

impl Seen<'_> {
    /// Distance of a return across its surface beyond the pose of its frame, m, with what was undone of its row, and
    /// its derivatives by the range and the elevation (m/rad) of the row. `None` where it is not of that surface.
    pub fn across(
        &self,
        ray: &Ray,
        poses: &OwnPoses,
        mount: &Mount,
        turn: &UnitQuaternion<f64>,
    ) -> Option<(f64, [f64; 2])> {
        let y = off_surface_m(ray, mount, poses)?;
        let x = [ray.range_lever(), elevation_lever(ray, turn)];
        let of_row = self.undone.get(&Group { sensor: ray.sensor, index: ray.row });
        let undone = of_row.map_or(0.0, |[range_m, elevation_rad]| x[0] * range_m + x[1] * elevation_rad);
        Some((y + undone, x))
    }
}

/// Sums of the returns from surfaces of some kinds (see [`super::mean::kind_of`]) of all frames.
pub fn group_frames(
    frames: &[FramePair],
    rig: &Rig,
    seen: Seen,
    (grouping, kinds): (Grouping, Range<usize>),
    noise_m: f64,
    design: f64,
) -> Vec<PartedFrame> {
    let mounts = super::own_poses::mounts(rig);
    let turns: Vec<_> = rig.sensors.iter().map(|s| s.pose().rotation).collect();
    let of_sensor = grouping.most();
    let half_fov: Vec<f64> = rig.sensors.iter().map(|s| s.half_fov_rad()).collect();
    let one = |(frame, poses): (&FramePair, &OwnPoses)| -> PartedFrame {
        let mut sums = vec![vec![[GroupSums::default(); PARTS]; of_sensor]; rig.sensors.len()];
        for ray in frame.measured.iter().filter(|r| usable(r)) {
            let kind = super::mean::kind_of(ray);
            let Some(group) = group_of(ray, grouping).filter(|_| kinds.contains(&kind)) else { continue };
            let sensor = ray.sensor as usize;
            let Some((y, x)) = seen.across(ray, poses, &mounts[sensor], &turns[sensor]) else { continue };
            let y = y - seen.structure[kind];
            let w = weight(ray, noise_m) / design;
            sums[sensor][usize::from(group.index)][part_of(ray, grouping, half_fov[sensor])].merge(&GroupSums {
                gram: [w * x[0] * x[0], w * x[0] * x[1], w * x[1] * x[1]],
                right: [w * x[0] * y, w * x[1] * y],
                n: 1.0,
                weight: w,
            });
        }
        std::array::from_fn(|part| {
            let of_sensor = |(sensor, sums): (usize, &Vec<[GroupSums; PARTS]>)| -> GroupFrame {
                let group = |index| Group { sensor: sensor as u8, index: index as u16 };
                let filled = sums.iter().enumerate().filter(|(_, s)| s[part].n > 0.0);
                filled.map(|(index, s)| (group(index), s[part])).collect()
            };
            sums.iter().enumerate().flat_map(of_sensor).collect()
        })
    };
    frames.par_iter().zip(seen.poses).map(one).collect()
}

/// Sums over the parts of a frame.
pub fn whole(frame: &PartedFrame) -> GroupFrame {
    total(frame.iter()).into_iter().collect()
}

/// Sums over frames, by group.
pub fn total<'a>(frames: impl Iterator<Item = &'a GroupFrame>) -> BTreeMap<Group, GroupSums> {
    let mut all = BTreeMap::<Group, GroupSums>::new();
    for (i, sums) in frames.flatten() {
        all.entry(*i).or_default().merge(sums);
    }
    all
}
