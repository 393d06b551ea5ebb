//! What may be wrong with where surfaces lie.

use crate::channels::groups::Grouping;
use crate::channels::mean::Column;
use crate::inference::choice::UNNAMED;
use crate::search::Context;

/// What may be wrong.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Suspect {
    Linear { name: &'static str, columns: Vec<usize> },
    Groups { name: &'static str, grouping: Grouping, column: usize },
}

impl Suspect {
    /// The cause's name.
    pub(super) fn name(&self) -> &'static str {
        match self {
            Suspect::Linear { name, .. } | Suspect::Groups { name, .. } => name,
        }
    }

    /// Free parameters; of groups as many as they are worth.
    pub(super) fn parameters(&self) -> usize {
        match self {
            Suspect::Linear { columns, .. } => columns.len(),
            Suspect::Groups { grouping: Grouping::Row, .. } => 12,
            Suspect::Groups { .. } => 14,
        }
    }
}

/// All suspects of a rig.
pub(super) fn suspects(context: &Context, columns: &[Column]) -> Vec<Suspect> {
    let at = |c: Column| columns.iter().position(|x| *x == c);
    let pick = |list: &[Column]| list.iter().filter_map(|c| at(*c)).collect::<Vec<_>>();
    let linear = |name, list: &[Column]| Suspect::Linear { name, columns: pick(list) };
    let mut all = vec![
        linear("range_bias", &[Column::RangeOffset]),
        linear("range_bias", &[Column::RangeScale]),
        linear("range_bias", &[Column::RangeOffset, Column::RangeScale]),
        linear("pitch_roll", &[Column::Pose(1)]),
        linear("pitch_roll", &[Column::Pose(0)]),
        linear("pitch_roll", &[Column::Pose(0), Column::Pose(1)]),
        linear("rolling_shutter", &[Column::Sweep(0)]),
        linear("rolling_shutter", &[Column::Sweep(2)]),
        linear("rolling_shutter", &[Column::Sweep(0), Column::Sweep(2)]),
    ];
    if context.rig.sensors.len() > 1 {
        for s in 0..context.rig.sensors.len() {
            for k in 0..3 {
                all.push(linear("sensor_extrinsics", &[Column::SensorPose(s, k)]));
            }
            all.push(linear("sensor_extrinsics", &[0, 1, 2].map(|k| Column::SensorPose(s, k))));
            all.push(linear("sensor_extrinsics", &[3, 4, 5].map(|k| Column::SensorPose(s, k))));
            all.push(linear("sensor_extrinsics", &[0, 1, 2, 3, 4, 5].map(|k| Column::SensorPose(s, k))));
        }
    } else {
        for k in 0..3 {
            all.push(linear("sensor_extrinsics", &[Column::Pose(k)]));
        }
        all.push(linear("sensor_extrinsics", &[0, 1, 2].map(Column::Pose)));
        all.push(linear("sensor_extrinsics", &[0, 1, 2, 3, 4, 5].map(Column::Pose)));
    }
    all.push(Suspect::Groups { name: "beam_range_offset", grouping: Grouping::Row, column: 0 });
    all.push(Suspect::Groups { name: "beam_elevation_offset", grouping: Grouping::Row, column: 1 });
    all.push(Suspect::Groups { name: UNNAMED, grouping: Grouping::Azimuth, column: 0 });
    all
}

/// Whether a suspect is a pose: on top of another one it mends what a turn leaves that is not small.
pub(super) fn is_pose(suspect: &Suspect) -> bool {
    matches!(suspect.name(), "pitch_roll" | "sensor_extrinsics")
}

/// Whether a suspect tells another story than those chosen.
pub(super) fn may_join(suspect: &Suspect, chosen: &[Suspect]) -> bool {
    chosen.iter().all(|c| {
        let grouped = |s: &Suspect| matches!(s, Suspect::Groups { .. });
        // A shear that is not small leaves every sensor with a turn and a shift of its own.
        let sheared = c.name() == "rolling_shutter";
        c.name() != suspect.name() && !sheared && !(grouped(c) && grouped(suspect))
    })
}
