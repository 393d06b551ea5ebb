//! A7: a constant range offset of each beam (row).

use super::row_table::{RowTable, by_row, by_table, check_rows, stream_of_row};
use super::{Draws, FrameContext, Need, Reads, SensorEffect};
use crate::scan::Scan;
use data::KeyError;
use data::toml_text::within;
use rand_distr::{Distribution, StandardNormal};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// All ranges of row b of a sensor are shifted by `offsets_m[b]`, m. If `offsets_m` is empty, the offset is
/// `std_m * N(0, 1)`, drawn once for each row of each sensor.
///
/// Typical: 1 to 5 cm (0.015 m) between the lasers of a Velodyne HDL-64E with the manufacturer's calibration; a third
/// of that after recalibration (Glennie and Lichti 2010).
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct BeamRangeOffset {
    /// Standard deviation between rows, m. Used if `offsets_m` is empty.
    pub std_m: f64,
    /// Offset of each row, m; replaces `std_m`. Of the rows of `rows_deg` where that is given; else of the rows from
    /// the top, the same for every sensor, and 0 for rows beyond the end of the list.
    pub offsets_m: Vec<f64>,
    /// Name of the sensor whose rows `rows_deg` gives.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub sensor: String,
    /// Elevations of that sensor's rows, ascending, degrees.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub rows_deg: Vec<f64>,
    /// Height of the origin of each row's rays over that of the sensor, m; empty where all rays start there.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub heights_m: Vec<f64>,
}

impl BeamRangeOffset {
    fn table(&self) -> RowTable<'_> {
        RowTable {
            sensor: &self.sensor,
            rows_deg: &self.rows_deg,
            heights_m: &self.heights_m,
            name: "offsets_m",
            most: 10.0,
            values: &self.offsets_m,
        }
    }

    fn offset_m(&self, sensor: u8, row: u16, draws: &Draws) -> f32 {
        if !self.offsets_m.is_empty() {
            return self.offsets_m.get(usize::from(row)).map_or(0.0, |v| *v as f32);
        }
        let noise: f32 = StandardNormal.sample(&mut stream_of_row(draws, sensor, row));
        self.std_m as f32 * noise
    }
}

impl SensorEffect for BeamRangeOffset {
    fn check(&self) -> Result<(), KeyError> {
        within("std_m", self.std_m, 0.0, 10.0)?;
        check_rows(&self.table())?;
        self.offsets_m.iter().enumerate().try_for_each(|(i, v)| within(&format!("offsets_m[{i}]"), *v, -10.0, 10.0))
    }

    fn needs(&self) -> Option<&'static [Need]> {
        Some(if self.rows_deg.is_empty() { &[Need::Row] } else { &[] })
    }

    fn reads(&self) -> Reads {
        if self.rows_deg.is_empty() { Reads::PATTERN } else { Reads::NOTHING }
    }

    fn sensor(&self) -> &str {
        if self.rows_deg.is_empty() { "" } else { &self.sensor }
    }

    fn on_scan(&self, scan: &mut Scan, frame: &FrameContext, draws: &Draws) {
        if !self.rows_deg.is_empty() {
            by_table(&self.table(), scan, frame, |echo, offset_m| echo.add_range(offset_m as f32));
            return;
        }
        by_row(scan, |sensor, row| self.offset_m(sensor, row, draws), |echo, offset_m| echo.add_range(offset_m));
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn rows_keep_their_offset_in_every_frame() {
        let (before, effect) = (scene(), BeamRangeOffset { std_m: 0.015, ..BeamRangeOffset::default() });
        let (one, other) = (applied_in(1, &effect, &before), applied_in(2, &effect, &before));
        assert_eq!(one, other);
        let mut of_row = vec![Vec::new(); GRID.0];
        for (a, b) in before.echoes.iter().zip(&one.echoes).filter(|(a, _)| a.is_return()) {
            of_row[usize::from(a.row)].push(f64::from(b.range_m - a.range_m));
        }
        let means: Vec<f64> = of_row
            .iter()
            .filter(|r| !r.is_empty())
            .map(|r| {
                let (mean, std) = moments(r);
                assert!(std < 1e-5);
                mean
            })
            .collect();
        let (_, std) = moments(&means);
        assert!((0.008..0.025).contains(&std), "{std}");
    }

    #[test]
    fn a_table_of_offsets_is_used_unchanged() {
        let before = plate(3000, 20.0, 0.5);
        let after =
            applied(&BeamRangeOffset { std_m: 0.0, offsets_m: vec![0.1, -0.2], ..BeamRangeOffset::default() }, &before);
        let off = residuals(&before, &after);
        assert!((off[0] - 0.1).abs() < 1e-5 && (off[1000] + 0.2).abs() < 1e-5 && off[2000] == 0.0);
    }

    #[test]
    fn a_table_by_elevation_belongs_to_one_sensor() {
        let before = scene();
        // The rows of the test scans, from the lowest.
        let rows_deg: Vec<f64> = (0..32).map(|row| -15.0 + 25.0 / 31.0 * f64::from(row)).collect();
        let offsets_m: Vec<f64> = (0..32).map(|row| 0.01 * f64::from(row)).collect();
        let table = |sensor: &str| BeamRangeOffset {
            std_m: 0.0,
            offsets_m: offsets_m.clone(),
            sensor: sensor.into(),
            rows_deg: rows_deg.clone(),
            heights_m: vec![],
        };
        assert_eq!(table("front").needs(), Some(&[][..]));
        let after = applied(&table("front"), &before);
        for (a, b) in after.returns().zip(before.returns()) {
            let want = 0.01 * (31.0 - f32::from(b.row));
            assert!((a.range_m - b.range_m - want).abs() < 1e-4, "row {}: {}", b.row, a.range_m - b.range_m);
        }
        assert_eq!(applied(&table("left"), &before), before, "another sensor's rows");
        for (effect, want) in [
            (BeamRangeOffset { sensor: String::new(), ..table("") }, "belongs to one sensor"),
            (BeamRangeOffset { offsets_m: vec![0.1], ..table("front") }, "1 values for 32 rows"),
            (BeamRangeOffset { rows_deg: rows_deg.iter().rev().copied().collect(), ..table("front") }, "is not larger"),
        ] {
            let error = effect.check().unwrap_err().to_string();
            assert!(error.contains(want), "{error}");
        }
    }
}
