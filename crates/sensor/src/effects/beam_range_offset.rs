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
        self.table().reads()
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
    use crate::cloud_scan::{CloudReader, Surfaces};
    use crate::directions::lasers::Beam;
    use crate::rig::Rig;
    use data::Cloud;

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

    /// Rows whose rays start at heights of their own are recognised by elevation and range, unless the cloud has rows
    /// by elevation alone.
    #[test]
    fn rows_with_heights_are_those_of_the_cones() {
        let lasers: Vec<Beam> = (0..16)
            .map(|k| Beam {
                elevation_rad: (-12.0 + 0.6 * f64::from(k)).to_radians(),
                height_m: if k < 8 { 0.12 } else { 0.2 },
            })
            .collect();
        let effect = BeamRangeOffset {
            sensor: "lidar".into(),
            rows_deg: lasers.iter().map(|l| l.elevation_rad.to_degrees()).collect(),
            heights_m: lasers.iter().map(|l| l.height_m).collect(),
            offsets_m: (1..17).map(|k| 0.01 * f64::from(k)).collect(),
            ..BeamRangeOffset::default()
        };
        effect.check().unwrap();
        let rig = Rig::single();
        for heights in [1.0, 0.0] {
            // By columns, so that the order of the points does not tell the lasers.
            let mut cloud = Cloud::new(3);
            for i in 0..600 {
                let azimuth = (0.3 + 0.6 * f64::from(i)).to_radians();
                for laser in lasers.iter().map(|l| Beam { height_m: heights * l.height_m, ..*l }) {
                    let range_m =
                        (4.0 + 20.0 * azimuth.sin().abs()).min((1.7 + laser.height_m) / -laser.direction(0.0).z);
                    cloud.values.extend(laser.point(azimuth, range_m).map(|v| v as f32).iter());
                }
            }
            let reader = CloudReader::of(&rig, std::slice::from_ref(&cloud), effect.reads());
            assert_eq!(reader.sensors().patterns[0].rows_rad.is_empty(), heights == 1.0);
            let before = reader.scan(&cloud, &Surfaces::default());
            let mut after = before.clone();
            with_frame(0, |frame, draws| {
                let frame = FrameContext { rig: &rig, sensors: Some(reader.sensors()), ..*frame };
                effect.on_scan(&mut after, &frame, draws);
            });
            let off = |i: usize| f64::from(after.echoes[i].range_m - before.echoes[i].range_m);
            let right = (0..cloud.len()).filter(|i| (off(*i) - 0.01 * (i % 16 + 1) as f64).abs() < 1e-3).count();
            assert!(right as f64 > 0.97 * cloud.len() as f64, "{right} of {}", cloud.len());
        }
    }
}
