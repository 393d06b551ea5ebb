//! Hypotheses about where surfaces lie.

use crate::catalogue::Cause;
use crate::channels::groups::Grouping;
use crate::channels::mean::Column;
use crate::channels::moments::COURSES;
use crate::search::Context;

/// A hypothesis: some columns of the linear fit, or one offset for each group of rays.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Hypothesis {
    Linear { cause: Cause, columns: Vec<usize> },
    Groups { cause: Cause, grouping: Grouping, column: usize },
}

impl Hypothesis {
    /// Its cause.
    pub(super) fn cause(&self) -> Cause {
        match self {
            Hypothesis::Linear { cause, .. } | Hypothesis::Groups { cause, .. } => *cause,
        }
    }

    /// Its columns of the linear fit.
    pub(super) fn columns(&self) -> &[usize] {
        match self {
            Hypothesis::Linear { columns, .. } => columns,
            Hypothesis::Groups { .. } => &[],
        }
    }

    /// Number of free parameters. Offsets of groups are shrunk by their prior: 12 for rows and 14 for strips of
    /// azimuth and steps of range are what they count.
    pub(super) fn parameters(&self) -> usize {
        match self {
            // The course of a drift is one of several.
            Hypothesis::Linear { cause: Cause::RangeDrift, columns } => columns.len() + 1,
            Hypothesis::Linear { columns, .. } => columns.len(),
            Hypothesis::Groups { grouping: Grouping::Row, .. } => 12,
            Hypothesis::Groups { .. } => 14,
        }
    }
}

/// All hypotheses of which columns are known, without a displacement over a scan where one was undone. With a single
/// sensor its pose and that of the scene are the same columns.
pub(super) fn hypotheses(context: &Context, columns: &[Column], undone: bool) -> Vec<Hypothesis> {
    let at = |c: Column| columns.iter().position(|x| *x == c);
    let pick = |list: &[Column]| list.iter().filter_map(|c| at(*c)).collect::<Vec<_>>();
    let linear = |cause, list: &[Column]| Hypothesis::Linear { cause, columns: pick(list) };
    let mut all = vec![
        linear(Cause::RangeBias, &[Column::RangeOffset]),
        linear(Cause::RangeBias, &[Column::RangeScale]),
        linear(Cause::RangeBias, &[Column::RangeOffset, Column::RangeScale]),
        linear(Cause::PitchRoll, &[Column::Pose(1)]),
        linear(Cause::PitchRoll, &[Column::Pose(0)]),
        linear(Cause::PitchRoll, &[Column::Pose(0), Column::Pose(1)]),
        linear(Cause::EgoAttitude, &[Column::Lean]),
        linear(Cause::RollingShutter, &[Column::Scan]),
        linear(Cause::RollingShutter, &[Column::Sweep(0)]),
        linear(Cause::RollingShutter, &[Column::Sweep(2)]),
        linear(Cause::RollingShutter, &[Column::Sweep(0), Column::Sweep(2)]),
    ];
    all.extend((0..COURSES).map(|k| linear(Cause::RangeDrift, &[Column::Drift(k)])));
    let mount = |list: &[Column]| linear(Cause::SensorExtrinsics, list);
    if context.rig.sensors.len() > 1 {
        for s in 0..context.rig.sensors.len() {
            for k in 0..3 {
                all.push(mount(&[Column::SensorPose(s, k)]));
            }
            all.push(mount(&[0, 1, 2].map(|k| Column::SensorPose(s, k))));
            all.push(mount(&[3, 4, 5].map(|k| Column::SensorPose(s, k))));
            all.push(mount(&[0, 1, 2, 3, 4, 5].map(|k| Column::SensorPose(s, k))));
        }
    } else {
        for k in 0..3 {
            all.push(mount(&[Column::Pose(k)]));
        }
        all.push(mount(&[0, 1, 2].map(Column::Pose)));
        all.push(mount(&[0, 1, 2, 3, 4, 5].map(Column::Pose)));
    }
    all.push(Hypothesis::Groups { cause: Cause::BeamRangeOffset, grouping: Grouping::Row, column: 0 });
    all.push(Hypothesis::Groups { cause: Cause::BeamElevationOffset, grouping: Grouping::Row, column: 1 });
    all.extend([Grouping::Azimuth, Grouping::Range].map(|grouping| Hypothesis::Groups {
        cause: Cause::Unexplained,
        grouping,
        column: 0,
    }));
    all.retain(|h| match h {
        Hypothesis::Linear { cause: Cause::RollingShutter, .. } if undone => false,
        Hypothesis::Linear { columns, .. } => !columns.is_empty(),
        Hypothesis::Groups { .. } => true,
    });
    all
}

/// Whether a column is a displacement over a scan.
pub(super) fn is_sweep(column: Column) -> bool {
    matches!(column, Column::Sweep(_) | Column::Scan | Column::Uneven)
}

/// Whether a hypothesis is a pose. A second pose may only compensate the non-linear part of a large first one.
pub(super) fn is_pose(hypothesis: &Hypothesis) -> bool {
    matches!(hypothesis.cause(), Cause::PitchRoll | Cause::SensorExtrinsics)
}

/// Whether a hypothesis is a constant attitude of the ego vehicle.
pub(super) fn is_attitude(hypothesis: &Hypothesis) -> bool {
    hypothesis.cause() == Cause::PitchRoll
}

/// Whether a hypothesis may be added to those chosen: another cause, one grouping of directions (by rows in range and
/// in elevation), and nothing after motion distortion. A strong shear leaves every sensor with an apparent turn and
/// shift of its own.
pub(super) fn may_join(hypothesis: &Hypothesis, chosen: &[Hypothesis]) -> bool {
    chosen.iter().all(|c| {
        let grouping = |h: &Hypothesis| match h {
            Hypothesis::Groups { grouping, .. } => Some(*grouping),
            Hypothesis::Linear { .. } => None,
        };
        let sheared = c.cause() == Cause::RollingShutter;
        let other = |(a, b): (Grouping, Grouping)| a != b && a != Grouping::Range && b != Grouping::Range;
        let grouped_otherwise = grouping(c).zip(grouping(hypothesis)).is_some_and(other);
        c.cause() != hypothesis.cause() && !sheared && !grouped_otherwise
    })
}
