//! B4: returns lost at grazing incidence.

use super::random_dropout::drop_some;
use super::{Draws, FrameContext, Need, SensorEffect};
use crate::scan::Scan;
use data::KeyError;
use data::toml_text::within;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A return at cosine of incidence c is lost with probability `1 / (1 + exp(steepness * (c - cos_half)))`, independent
/// of range.
///
/// Typical: half at 85 to 88 degrees (cos 0.09 to 0.03) for diffuse surfaces, at 60 to 75 degrees for paint and metal
/// (Muckenhuber et al. 2020 measured nine automotive materials); steepness 120.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct IncidenceDropout {
    /// Cosine of the angle of incidence at which half of the returns are lost.
    pub cos_half: f64,
    /// Steepness of the logistic function, per unit of the cosine.
    pub steepness: f64,
}

impl SensorEffect for IncidenceDropout {
    fn check(&self) -> Result<(), KeyError> {
        within("cos_half", self.cos_half, -1.0, 1.0)?;
        within("steepness", self.steepness, 0.1, 1e4)
    }

    fn needs(&self) -> Option<&'static [Need]> {
        Some(&[Need::Incidence])
    }

    fn on_scan(&self, scan: &mut Scan, _frame: &FrameContext, draws: &Draws) {
        let (half, steepness) = (self.cos_half as f32, self.steepness as f32);
        drop_some(scan, draws, |echo| 1.0 / (1.0 + (steepness * (echo.cos_incidence - half)).exp()));
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn it_depends_on_the_angle_alone() {
        let effect = IncidenceDropout { cos_half: 0.2, steepness: 20.0 };
        for (range_m, c) in [(10.0, 0.2), (90.0, 0.2), (10.0, 0.1), (10.0, 0.4)] {
            let mut before = plate(20_000, range_m, 0.5);
            before.echoes.iter_mut().for_each(|e| e.cos_incidence = c);
            let want = 1.0 / (1.0 + (20.0 * (f64::from(c) - 0.2)).exp());
            let got = lost(&before, &applied(&effect, &before));
            assert!((got - want).abs() < 0.012, "{c}: {got} {want}");
        }
    }
}
