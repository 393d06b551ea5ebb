//! Tables by row of one sensor, whose rows are distinguished by their elevations.

use super::{Draws, FrameContext, Reads};
use crate::directions::ScanPattern;
use crate::scan::{Echo, Scan};
use data::KeyError;
use data::toml_text::{within, wrong};
use geometry::Pose;
use nalgebra::Vector3;

/// Values of the rows of a sensor.
pub(super) struct RowTable<'a> {
    /// Name of the sensor.
    pub sensor: &'a str,
    /// Elevations, ascending, degrees.
    pub rows_deg: &'a [f64],
    /// Heights of the origins of their rays over that of the sensor, m; empty where they start there. A simulation
    /// whose rays start in one point all the same has its rows at their elevations.
    pub heights_m: &'a [f64],
    /// Name of the values, and their largest magnitude.
    pub name: &'static str,
    pub most: f64,
    pub values: &'a [f64],
}

impl RowTable<'_> {
    /// What an effect by this table reads of a finished cloud.
    pub(super) fn reads(&self) -> Reads {
        if self.rows_deg.is_empty() || !self.heights_m.is_empty() { Reads::PATTERN } else { Reads::NOTHING }
    }
}

/// Rows of a sensor of the rig.
pub(super) struct Rows {
    sensor: usize,
    sensor_from_cloud: Pose,
    pattern: ScanPattern,
}

impl Rows {
    /// Rows of a table; `None` where the rig does not have the sensor.
    pub(super) fn of(table: &RowTable, frame: &FrameContext) -> Option<Rows> {
        let number = frame.rig.find(table.sensor)?;
        let mut rows = Rows::new(number, frame.rig.sensors[number].pose().inverse(), table);
        let from_one_point = |p: &ScanPattern| !p.rows_rad.is_empty() && p.heights_m.is_empty();
        if frame.sensors.is_none_or(|sensors| from_one_point(&sensors.patterns[number])) {
            rows.pattern.heights_m.clear();
        }
        Some(rows)
    }

    /// Rows of the sensor with this number.
    pub(super) fn new(sensor: usize, sensor_from_cloud: Pose, table: &RowTable) -> Rows {
        let rows_rad = table.rows_deg.iter().map(|deg| deg.to_radians() as f32).collect();
        let heights_m = table.heights_m.iter().map(|m| *m as f32).collect();
        Rows { sensor, sensor_from_cloud, pattern: ScanPattern { rows_rad, heights_m, ..ScanPattern::default() } }
    }

    /// The row of an echo; `None` for echoes of other sensors and between rows.
    pub(super) fn row(&self, echo: &Echo) -> Option<usize> {
        if usize::from(echo.sensor) != self.sensor {
            return None;
        }
        let own = self.sensor_from_cloud.rotation * Vector3::from(echo.direction.map(f64::from));
        self.of_direction(own, echo.range_m)
    }

    /// The row of a direction in the sensor's frame, and of the range of the return there.
    pub(super) fn of_direction(&self, own: Vector3<f64>, range_m: f32) -> Option<usize> {
        self.pattern.row(own.z.atan2(own.x.hypot(own.y)) as f32, range_m)
    }
}

/// Changes the returns of a sensor by the values of its rows. Nothing changes where the rig does not have the sensor.
pub(super) fn by_table(table: &RowTable, scan: &mut Scan, frame: &FrameContext, change: impl Fn(&mut Echo, f64)) {
    let Some(rows) = Rows::of(table, frame) else { return };
    for echo in scan.returns_mut() {
        if let Some(row) = rows.row(echo) {
            change(echo, table.values[row]);
        }
    }
}

/// Changes all returns by a value of their sensor and row.
pub(super) fn by_row(scan: &mut Scan, of_row: impl Fn(u8, u16) -> f32, change: impl Fn(&mut Echo, f32)) {
    // Rows follow each other.
    let mut last: Option<((u8, u16), f32)> = None;
    for echo in scan.returns_mut() {
        let row = (echo.sensor, echo.row);
        let value = match last {
            Some((known, value)) if known == row => value,
            _ => of_row(row.0, row.1),
        };
        last = Some((row, value));
        change(echo, value);
    }
}

/// The random numbers of a row, the same in every frame.
pub(super) fn stream_of_row(draws: &Draws, sensor: u8, row: u16) -> data::Stream {
    draws.of_set(u64::from(sensor) << 16 | u64::from(row))
}

/// Checks a table: the sensor is named, rows ascend, there are at least two and as many values, and as many heights or
/// none.
pub(super) fn check_rows(table: &RowTable) -> Result<(), KeyError> {
    let RowTable { sensor, rows_deg, heights_m, name, most, values } = *table;
    if rows_deg.is_empty() {
        return Ok(());
    }
    if sensor.is_empty() {
        return Err(wrong("sensor", "is missing: a table by row belongs to one sensor"));
    }
    if !heights_m.is_empty() && heights_m.len() != rows_deg.len() {
        let why = format!("{} values for {} rows: there is one for each, or none", heights_m.len(), rows_deg.len());
        return Err(wrong("heights_m", why));
    }
    heights_m.iter().enumerate().try_for_each(|(i, v)| within(&format!("heights_m[{i}]"), *v, -10.0, 10.0))?;
    if rows_deg.len() < 2 || rows_deg.len() != values.len() {
        let why =
            format!("{} values for {} rows: a table has as many of each, at least 2", values.len(), rows_deg.len());
        return Err(wrong(name, why));
    }
    if let Some(i) = rows_deg.windows(2).position(|w| w[0] >= w[1]) {
        return Err(wrong(format!("rows_deg[{}]", i + 1), "is not larger than the previous value"));
    }
    rows_deg.iter().enumerate().try_for_each(|(i, v)| within(&format!("rows_deg[{i}]"), *v, -90.0, 90.0))?;
    values.iter().enumerate().try_for_each(|(i, v)| within(&format!("{name}[{i}]"), *v, -most, most))
}
