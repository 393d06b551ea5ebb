//! D9: a gain of the intensity of each beam (row).

use super::row_table::{RowTable, by_row, by_table, check_rows, stream_of_row};
use super::{Draws, FrameContext, Need, Reads, SensorEffect};
use crate::scan::Scan;
use data::KeyError;
use data::toml_text::within;
use rand_distr::{Distribution, StandardNormal};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// All intensities of row b of a sensor are multiplied by `exp(gains_ln[b])`. If `gains_ln` is empty, the logarithm is
/// `std * N(0, 1)`, drawn once for each row of each sensor.
///
/// Typical: 0.05 to 0.3 between the lasers of a spinning sensor with the manufacturer's calibration.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct BeamIntensity {
    /// Standard deviation of the logarithm between rows. Used if `gains_ln` is empty.
    pub std: f64,
    /// Logarithm of the gain of each row; replaces `std`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub gains_ln: Vec<f64>,
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

impl BeamIntensity {
    fn table(&self) -> RowTable<'_> {
        RowTable {
            sensor: &self.sensor,
            rows_deg: &self.rows_deg,
            heights_m: &self.heights_m,
            name: "gains_ln",
            most: 10.0,
            values: &self.gains_ln,
        }
    }
}

impl SensorEffect for BeamIntensity {
    fn check(&self) -> Result<(), KeyError> {
        within("std", self.std, 0.0, 3.0)?;
        if self.rows_deg.is_empty() && !self.gains_ln.is_empty() {
            return Err(data::toml_text::wrong(
                "rows_deg",
                "is missing: it gives the elevations of the rows of gains_ln",
            ));
        }
        check_rows(&self.table())
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
            by_table(&self.table(), scan, frame, |echo, gain_ln| echo.intensity *= gain_ln.exp() as f32);
            return;
        }
        if self.std == 0.0 {
            return;
        }
        let gain = |sensor: u8, row: u16| {
            let noise: f64 = StandardNormal.sample(&mut stream_of_row(draws, sensor, row));
            (self.std * noise).exp() as f32
        };
        by_row(scan, gain, |echo, gain| echo.intensity *= gain);
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn rows_keep_their_gain_in_every_frame() {
        let (before, effect) = (scene(), BeamIntensity { std: 0.2, ..BeamIntensity::default() });
        let (one, other) = (applied_in(1, &effect, &before), applied_in(2, &effect, &before));
        assert_eq!(one, other);
        let mut of_row = vec![Vec::new(); GRID.0];
        for (a, b) in before.echoes.iter().zip(&one.echoes).filter(|(a, _)| a.is_return()) {
            of_row[usize::from(a.row)].push(f64::from(b.intensity / a.intensity).ln());
        }
        of_row.retain(|row| !row.is_empty());
        assert!(of_row.iter().all(|row| moments(row).1 < 1e-5));
        let (_, std) = moments(&of_row.iter().map(|row| row[0]).collect::<Vec<_>>());
        assert!((0.12..0.3).contains(&std), "{std}");
    }

    #[test]
    fn a_table_by_elevation_belongs_to_one_sensor() {
        let before = scene();
        let table = |sensor: &str| BeamIntensity {
            std: 0.0,
            gains_ln: (0..32).map(|row| 0.1 * f64::from(row)).collect(),
            sensor: sensor.into(),
            rows_deg: (0..32).map(|row| -15.0 + 25.0 / 31.0 * f64::from(row)).collect(),
            heights_m: vec![],
        };
        let after = applied(&table("front"), &before);
        for (a, b) in after.returns().zip(before.returns()) {
            let want = (0.1 * (31.0 - f32::from(b.row))).exp();
            assert!((a.intensity / b.intensity / want - 1.0).abs() < 1e-4, "row {}", b.row);
        }
        assert_eq!(applied(&table("left"), &before), before, "another sensor's rows");
        let without_rows = BeamIntensity { gains_ln: vec![0.1], ..BeamIntensity::default() };
        assert!(without_rows.check().unwrap_err().to_string().contains("rows_deg"));
    }
}
