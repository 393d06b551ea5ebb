//! What the grids of programs with equal steps can express of a rig's patterns.

use crate::placement::{NotExpressed, Remedy};
use crate::plan::SensorPlan;

/// What to say of a sensor whose directions are not a grid.
pub(crate) fn without_grid(sensor: &SensorPlan) -> Option<NotExpressed> {
    sensor.blocks.is_empty().then(|| NotExpressed {
        index: None,
        kind: "pattern",
        why: format!(
            "the rows and columns of the sensor {:?} are not known: the rig has no pattern with blocks for it",
            sensor.name
        ),
        remedy: Remedy::Scenario {
            change: "give a rig with `pattern = { blocks = [...], columns = N }` (--rig), or fill in the grid".into(),
        },
    })
}

/// Azimuth of the first and the last column, counter-clockwise from the sensor's x axis, degrees. A grid of N columns
/// has N steps over the field of view.
pub(crate) fn first_and_last_deg(sensor: &SensorPlan) -> [f64; 2] {
    let step = sensor.fov_deg / f64::from(sensor.columns.max(1));
    let left = (sensor.fov_deg - step) / 2.0;
    [left, -left]
}
