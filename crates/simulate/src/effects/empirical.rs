//! E4: what has been seen and has no name, as a table.

use super::{Draws, FrameContext, SensorEffect};
use crate::SimulateError;
use crate::error::{within, wrong};
use crate::scan::{Echo, Scan};
use rand::RngExt;
use rand_distr::{Distribution, StandardNormal};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// What an [`Empirical`] table depends on, in the cloud's frame as seen from the sensor.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Covariate {
    /// Counter-clockwise from +x, -180 to 180 degrees.
    AzimuthDeg,
    /// Upwards from the horizon, degrees.
    ElevationDeg,
    /// m.
    RangeM,
}

/// A table along a covariate: share of the returns that is kept, what ranges are off by, and the deviation of what is added to them. Between
/// its points on the line, beyond its ends that of the end.
///
/// Typical: what a diagnosis found and could not name.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Empirical {
    /// Number of the sensor in its rig; every sensor when left out.
    pub sensor: Option<u8>,
    /// What the table depends on.
    pub covariate: Covariate,
    /// Places, ascending.
    pub at: Vec<f64>,
    /// Share kept at each place, 0 to 1; empty: all are kept.
    pub kept: Vec<f64>,
    /// Added to ranges at each place, m; empty: nothing.
    pub offset_m: Vec<f64>,
    /// Standard deviation of noise along the ray at each place, m; empty: none.
    pub std_m: Vec<f64>,
}

impl Default for Empirical {
    fn default() -> Self {
        let (at, kept) = (vec![-180.0, 0.0, 180.0], vec![1.0, 0.9, 1.0]);
        Empirical { sensor: None, covariate: Covariate::AzimuthDeg, at, kept, offset_m: vec![], std_m: vec![] }
    }
}

impl Empirical {
    fn place(&self, echo: &Echo) -> f64 {
        let [x, y, z] = echo.direction.map(f64::from);
        match self.covariate {
            Covariate::AzimuthDeg => y.atan2(x).to_degrees(),
            Covariate::ElevationDeg => z.clamp(-1.0, 1.0).asin().to_degrees(),
            Covariate::RangeM => f64::from(echo.range_m),
        }
    }

    fn told(&self, values: &[f64], place: f64) -> f64 {
        let after = self.at.partition_point(|a| *a <= place);
        if after == 0 || after == self.at.len() {
            return values[after.min(values.len() - 1)];
        }
        let t = (place - self.at[after - 1]) / (self.at[after] - self.at[after - 1]);
        values[after - 1] + t * (values[after] - values[after - 1])
    }

    fn concerns(&self, echo: &Echo) -> bool {
        self.sensor.is_none_or(|s| s == echo.sensor)
    }
}

impl SensorEffect for Empirical {
    fn check(&self) -> Result<(), SimulateError> {
        if let Some(i) = self.at.windows(2).position(|w| !(w[0] < w[1])) {
            return Err(wrong(format!("at[{}]", i + 1), "is not larger than the one before"));
        }
        for (name, values, low, high) in
            [("kept", &self.kept, 0.0, 1.0), ("offset_m", &self.offset_m, -10.0, 10.0), ("std_m", &self.std_m, 0.0, 10.0)]
        {
            if !values.is_empty() && values.len() != self.at.len() {
                return Err(wrong(name, format!("{} places and {} values make no table", self.at.len(), values.len())));
            }
            values.iter().enumerate().try_for_each(|(i, v)| within(&format!("{name}[{i}]"), *v, low, high))?;
        }
        self.at.iter().enumerate().try_for_each(|(i, v)| within(&format!("at[{i}]"), *v, -1e4, 1e4))
    }

    fn on_scan(&self, scan: &mut Scan, _frame: &FrameContext, draws: &Draws) {
        let mut random = draws.of_frame();
        for echo in scan.returns_mut().filter(|e| self.concerns(e)) {
            let place = self.place(echo);
            let [chance, noise]: [f64; 2] = [random.random(), StandardNormal.sample(&mut random)];
            if !self.kept.is_empty() && chance >= self.told(&self.kept, place) {
                echo.lose();
                continue;
            }
            let mut off = if self.offset_m.is_empty() { 0.0 } else { self.told(&self.offset_m, place) };
            if !self.std_m.is_empty() {
                off += noise * self.told(&self.std_m, place);
            }
            echo.range_m = (echo.range_m + off as f32).max(0.01);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn losses_and_offsets_follow_the_table() {
        let table = Empirical {
            sensor: None,
            covariate: Covariate::RangeM,
            at: vec![10.0, 50.0],
            kept: vec![1.0, 0.5],
            offset_m: vec![0.0, 0.4],
            std_m: vec![],
        };
        let before = plate(20_000, 30.0, 0.5);
        let after = applied(&table, &before);
        assert!((lost(&before, &after) - 0.25).abs() < 0.012);
        let far = after.returns().next().unwrap().range_m;
        assert!((far - 30.2).abs() < 1e-3, "{far}");
        let other = Empirical { sensor: Some(7), ..table };
        assert_eq!(applied(&other, &before).echoes, before.echoes);
    }

    #[test]
    fn bad_tables_are_refused() {
        let good = Empirical::default();
        for (effect, want) in [
            (Empirical { at: vec![0.0, 0.0, 1.0], ..good.clone() }, "at[1]: is not larger"),
            (Empirical { kept: vec![0.5], ..good.clone() }, "no table"),
            (Empirical { kept: vec![0.5, 0.5, 1.5], ..good }, "kept[2]: 1.5"),
        ] {
            assert!(effect.check().unwrap_err().to_string().contains(want));
        }
    }
}
