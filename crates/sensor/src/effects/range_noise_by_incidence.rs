//! A4: range noise from the footprint on inclined surfaces.

use super::range_noise::add_noise;
use super::{Draws, FrameContext, Need, Reads, SensorEffect};
use crate::scan::Scan;
use data::KeyError;
use data::toml_text::within;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// `s * N(0, 1)`, m, is added to a range R, with `s = min(R * divergence_rad / 2 * tan(i) / sqrt(samples), most_m)`, i
/// the angle of incidence. An inclined footprint spreads the return over range, and the receiver averages over
/// `samples` independent samples of it.
///
/// Typical: 0.7 to 3 mrad (Velodyne VLP-16 3 mrad, Ouster OS1 0.13 to 0.18 degrees), a few samples, most_m 0.5.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RangeNoiseByIncidence {
    /// Full divergence angle of the beam, rad.
    pub divergence_rad: f64,
    /// Number of independent samples that the receiver averages.
    pub samples: f64,
    /// Upper limit of the standard deviation, m.
    pub most_m: f64,
}

impl Default for RangeNoiseByIncidence {
    fn default() -> Self {
        RangeNoiseByIncidence { divergence_rad: 0.0, samples: 4.0, most_m: 10.0 }
    }
}

impl SensorEffect for RangeNoiseByIncidence {
    fn check(&self) -> Result<(), KeyError> {
        within("divergence_rad", self.divergence_rad, 0.0, 0.1)?;
        within("samples", self.samples, 1.0, 1e6)?;
        within("most_m", self.most_m, 0.0, 10.0)
    }

    fn needs(&self) -> Option<&'static [Need]> {
        Some(&[Need::Incidence])
    }

    fn reads(&self) -> Reads {
        Reads::SURFACES
    }

    fn on_scan(&self, scan: &mut Scan, _frame: &FrameContext, draws: &Draws) {
        let factor = (self.divergence_rad / 2.0 / self.samples.sqrt()) as f32;
        add_noise(scan, draws, |echo| {
            let c = echo.cos_incidence.max(1e-3);
            let tan = (1.0 - c * c).max(0.0).sqrt() / c;
            (factor * echo.range_m * tan).min(self.most_m as f32)
        });
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn at_normal_incidence_there_is_no_noise() {
        let effect = RangeNoiseByIncidence { divergence_rad: 0.004, samples: 4.0, most_m: 0.5 };
        let before = plate(1000, 50.0, 0.5);
        assert_eq!(residuals(&before, &applied(&effect, &before)), vec![0.0; 1000]);
    }

    #[test]
    fn the_deviation_follows_range_and_incidence() {
        let effect = RangeNoiseByIncidence { divergence_rad: 0.004, samples: 4.0, most_m: 0.5 };
        for (range_m, degrees) in [(20.0, 60.0_f32), (60.0, 80.0), (20.0, 89.9)] {
            let mut before = plate(20_000, range_m, 0.5);
            before.echoes.iter_mut().for_each(|e| e.cos_incidence = degrees.to_radians().cos());
            let (_, std) = moments(&residuals(&before, &applied(&effect, &before)));
            let want = (f64::from(range_m) * 0.001 * f64::from(degrees.to_radians().tan())).min(0.5);
            assert!((std / want - 1.0).abs() < 0.04, "{range_m} {degrees}: {std} {want}");
        }
    }
}
