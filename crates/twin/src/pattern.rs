//! The sensor of a recording: its rows and steps as a rig for the simulator.

use crate::TwinError;
use crate::recording::Recording;
use data::toml_text::wrong;
use data::write_atomic;
use sensor::rig::{Pattern, Rig};
use std::f64::consts::TAU;
use std::path::Path;

/// Scans of which the pattern is taken.
const SCANS: usize = 5;

/// Writes `sensor.toml` and `sensor_shots.csv`: one sensor at the origin of the clouds whose rows have the median
/// elevations of the recording's rows. Without rows `sensor.toml` has the field of view and the ranges alone.
///
/// The shots of a row are at equal steps from azimuth 0: the phase of a row differs from scan to scan. Times assume a
/// sensor that turns once clockwise in a frame, which passes its x axis in the middle.
pub fn write(recording: &Recording, out: &Path) -> Result<(), TwinError> {
    let every = (recording.len() / SCANS).max(1);
    let (mut rows, mut far, mut near) = (Vec::new(), 0.0f64, f64::INFINITY);
    for frame in (0..recording.len()).step_by(every) {
        let scan = recording.scan(frame)?;
        for range in &scan.returns.range_m {
            far = far.max(f64::from(*range));
            near = near.min(f64::from(*range));
        }
        let elevations = scan.rows.as_ref().map(|r| r.elevations_rad(&scan.returns)).unwrap_or_default();
        if elevations.len() > rows.len() {
            rows = elevations;
        }
    }
    let stamps: Vec<f64> = recording.moments().iter().filter_map(|m| m.stamp_s).collect();
    let gaps = stamps.windows(2).map(|w| w[1] - w[0]).filter(|gap| *gap > 1e-3);
    let period_s = statistics::median_upper(gaps.collect::<Vec<_>>()).unwrap_or(0.1);
    let mut rig = Rig::single();
    let sensor = &mut rig.sensors[0];
    (sensor.min_range_m, sensor.max_range_m) = (near.max(0.1), far.max(1.0));
    sensor.rate_hz = 1.0 / period_s;
    if !rows.is_empty() {
        rows.sort_by(|a, b| b.total_cmp(a));
        let columns = (TAU / f64::from(recording.steps().azimuth_rad)).round().max(1.0) as usize;
        let mut text = String::from("azimuth_deg,elevation_deg,time_s,row,column\n");
        for (row, elevation) in rows.iter().enumerate() {
            for column in 0..columns {
                let azimuth = 180.0 - 360.0 * (column as f64 + 0.5) / columns as f64;
                let time = period_s * ((column as f64 + 0.5) / columns as f64 - 0.5);
                text += &format!("{azimuth:.4},{:.4},{time:.6},{row},{column}\n", elevation.to_degrees());
            }
        }
        write_atomic(&out.join("sensor_shots.csv"), text.as_bytes())?;
        sensor.pattern = Some(Pattern::of_file("sensor_shots.csv".into()));
    }
    let text = toml::to_string_pretty(&rig).map_err(|e| wrong("sensor", e.to_string()))?;
    Ok(write_atomic(&out.join("sensor.toml"), text.as_bytes())?)
}
