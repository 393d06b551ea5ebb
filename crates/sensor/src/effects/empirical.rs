//! E4: lookup tables of loss, range offset and range noise over one covariate, without a physical model.

use super::table::{check_table, interpolated};
use super::{Draws, FrameContext, Need, Reads, SensorEffect};
use crate::scan::{Echo, Scan, dot};
use data::KeyError;
use nalgebra::Vector3;
use rand::RngExt;
use rand_distr::{Distribution, StandardNormal};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Covariate of the tables of [`Empirical`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Covariate {
    /// Range, m.
    #[default]
    RangeM,
    /// Cosine of the angle of incidence.
    CosIncidence,
    /// Signal index `ln(returned / R^2) - ln(0.1 / 250^2)`, R the range, m; 0 at the data sheet's maximum range, 250 m
    /// at 10 % reflectivity.
    Signal,
    /// Azimuth in the sensor's frame, degrees counter-clockwise from its x axis.
    AzimuthDeg,
    /// Elevation in the sensor's frame, degrees.
    ElevationDeg,
    /// Row of the pattern, counted from the top.
    Row,
}

/// At value x of the covariate, a return is lost with probability `loss(x)`, and its range error is
/// `mean_m(x) + std_m(x) * N(0, 1)`, m. Tables are interpolated linearly between the points (`at`, value) and constant
/// beyond both ends. An empty list is 0 everywhere.
///
/// This effect has no physical cause or formula. A diagnosis writes it for differences that it measures but cannot
/// attribute to a cause.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Empirical {
    /// Name of the sensor; empty for all sensors.
    pub sensor: String,
    /// Covariate of the tables.
    pub covariate: Covariate,
    /// Values of the covariate, strictly ascending.
    pub at: Vec<f64>,
    /// Probability of a loss at each value of `at`, 0 to 1.
    pub loss: Vec<f64>,
    /// Mean range error at each value of `at`, m.
    pub mean_m: Vec<f64>,
    /// Standard deviation of the range error at each value of `at`, m.
    pub std_m: Vec<f64>,
}

impl Empirical {
    fn tables(&self) -> [(&'static str, &Vec<f64>, [f64; 2]); 3] {
        [("loss", &self.loss, [0.0, 1.0]), ("mean_m", &self.mean_m, [-10.0, 10.0]), ("std_m", &self.std_m, [0.0, 10.0])]
    }

    fn value(&self, echo: &Echo, frame: &FrameContext) -> f64 {
        let angles = || {
            let direction = Vector3::from(echo.direction.map(f64::from));
            let own = frame.rig.sensors[usize::from(echo.sensor)].pose().rotation.inverse() * direction;
            [own.y.atan2(own.x), own.z.atan2(own.x.hypot(own.y))].map(f64::to_degrees)
        };
        match self.covariate {
            Covariate::RangeM => echo.range_m.into(),
            Covariate::CosIncidence => dot(echo.normal, echo.direction).abs().into(),
            Covariate::Signal => echo.signal().into(),
            Covariate::AzimuthDeg => angles()[0],
            Covariate::ElevationDeg => angles()[1],
            Covariate::Row => echo.row.into(),
        }
    }
}

impl SensorEffect for Empirical {
    fn check(&self) -> Result<(), KeyError> {
        let tables = self.tables().into_iter().filter(|(_, values, _)| !values.is_empty());
        for (name, values, [low, high]) in tables {
            check_table(("at", &self.at, [-1e4, 1e4]), (name, values, [low, high]))?;
        }
        Ok(())
    }

    fn reads(&self) -> Reads {
        match self.covariate {
            Covariate::RangeM | Covariate::AzimuthDeg | Covariate::ElevationDeg => Reads::NOTHING,
            Covariate::CosIncidence | Covariate::Signal => Reads::SURFACES,
            Covariate::Row => Reads::PATTERN,
        }
    }

    fn sensor(&self) -> &str {
        &self.sensor
    }

    fn needs(&self) -> Option<&'static [Need]> {
        Some(match self.covariate {
            Covariate::RangeM | Covariate::AzimuthDeg | Covariate::ElevationDeg => &[],
            Covariate::CosIncidence => &[Need::Incidence],
            Covariate::Signal => &[Need::Incidence, Need::Reflectivity],
            Covariate::Row => &[Need::Row],
        })
    }

    fn on_scan(&self, scan: &mut Scan, frame: &FrameContext, draws: &Draws) {
        let only = frame.rig.find(&self.sensor);
        if !self.sensor.is_empty() && only.is_none() {
            return;
        }
        let at = |values: &[f64], x: f64| if values.is_empty() { 0.0 } else { interpolated(&self.at, values, x) };
        let mut random = draws.of_frame();
        for echo in scan.returns_mut().filter(|e| only.is_none_or(|s| usize::from(e.sensor) == s)) {
            let x = self.value(echo, frame);
            let lost = random.random_range(0.0..1.0_f64) < at(&self.loss, x);
            let noise: f64 = StandardNormal.sample(&mut random);
            let off = at(&self.mean_m, x) + at(&self.std_m, x) * noise;
            echo.add_range(off as f32);
            if lost {
                echo.lose();
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn losses_offsets_and_noise_follow_their_tables() {
        let effect = Empirical {
            at: vec![10.0, 50.0],
            loss: vec![0.1, 0.5],
            mean_m: vec![0.1, -0.1],
            std_m: vec![0.0, 0.08],
            ..Empirical::default()
        };
        for (range_m, loss, mean, std) in [(5.0, 0.1, 0.1, 0.0), (30.0, 0.3, 0.0, 0.04), (80.0, 0.5, -0.1, 0.08)] {
            let before = plate(20_000, range_m, 0.5);
            let after = applied(&effect, &before);
            assert!((lost(&before, &after) - loss).abs() < 0.012, "{range_m}");
            let (m, s) = moments(&residuals(&before, &after));
            assert!((m - mean).abs() < 2e-3 && (s - std).abs() < 2e-3, "{range_m}: {m} {s}");
        }
    }

    #[test]
    fn azimuth_and_elevation_are_in_the_sensor_s_frame() {
        let before = scene();
        let to_the_left = Empirical {
            covariate: Covariate::AzimuthDeg,
            at: vec![-0.1, 0.1],
            mean_m: vec![0.0, 0.5],
            ..Empirical::default()
        };
        let after = applied(&to_the_left, &before);
        for (a, b) in before.echoes.iter().zip(&after.echoes).filter(|(a, _)| a.is_return()) {
            let azimuth = f64::from(a.direction[1].atan2(a.direction[0])).to_degrees();
            if azimuth.abs() > 0.2 {
                let want = if azimuth > 0.0 { 0.5 } else { 0.0 };
                assert!((f64::from(b.range_m - a.range_m) - want).abs() < 1e-4, "{azimuth}");
            }
        }
        let of_another = Empirical { sensor: "rear".into(), ..to_the_left };
        assert_eq!(applied(&of_another, &before), before);
    }

    #[test]
    fn bad_tables_are_refused() {
        let table =
            |at: &[f64], std_m: &[f64]| Empirical { at: at.into(), std_m: std_m.into(), ..Empirical::default() };
        for (effect, want) in [
            (table(&[], &[0.1]), "as many of each"),
            (table(&[1.0, 2.0], &[0.1]), "as many of each"),
            (table(&[1.0, 1.0], &[0.1, 0.2]), "at[1]: is not larger"),
            (table(&[1.0, 2.0], &[0.1, -1.2]), "std_m[1]: -1.2"),
        ] {
            assert!(effect.check().unwrap_err().to_string().contains(want));
        }
    }
}
