//! B4: returns lost at grazing incidence.

use super::assumed::boxes;
use super::form::{EstimatedIncidence, Form, factor};
use super::random_dropout::drop_some;
use super::{Draws, FrameContext, Need, Reads, SensorEffect};
use crate::scan::Scan;
use data::KeyError;
use data::toml_text::within;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A return at cosine of incidence c is kept with probability `most * (1 + exp(-steepness * (x - x0)))^-skew`,
/// independent of range, x the cosine or its logarithm (`scale`). It is half of `most` at `cos_half`, which gives x0.
///
/// Typical: half at 85 to 88 degrees (cos 0.09 to 0.03) for diffuse surfaces, at 60 to 75 degrees for paint and metal
/// (Muckenhuber et al. 2020 measured nine automotive materials); steepness 120.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct IncidenceDropout {
    /// Cosine of the angle of incidence at which half of the returns are lost.
    pub cos_half: f64,
    /// Steepness of the logistic function, per unit of x.
    pub steepness: f64,
    /// What x is.
    #[serde(default)]
    pub scale: CosineScale,
    /// Exponent of the logistic function, which lets its two tails differ; 1 for none.
    #[serde(default = "one")]
    pub skew: f64,
    /// Share that is kept where the law has no effect, 0 to 1.
    #[serde(default = "one")]
    pub most: f64,
    /// Correction of the form over x.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub form: Option<Form>,
    /// What is lost in finished clouds, whose angles of incidence are estimated; factors over x.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub estimated_incidence: Option<Box<EstimatedIncidence>>,
}

/// Scale of the cosine in [`IncidenceDropout`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum CosineScale {
    /// The cosine.
    #[default]
    Linear,
    /// Its natural logarithm.
    Log,
}

fn one() -> f64 {
    1.0
}

impl SensorEffect for IncidenceDropout {
    fn check(&self) -> Result<(), KeyError> {
        let least = if self.scale == CosineScale::Log { 1e-9 } else { -1.0 };
        let largest = if self.scale == CosineScale::Log { 1e9 } else { 1.0 };
        within("cos_half", self.cos_half, least, largest)?;
        within("steepness", self.steepness, 0.01, 1e4)?;
        within("skew", self.skew, 0.01, 100.0)?;
        within("most", self.most, 0.0, 1.0)?;
        self.form.as_ref().map_or(Ok(()), Form::check)?;
        self.estimated_incidence.as_ref().map_or(Ok(()), |estimated| estimated.check())
    }

    fn needs(&self) -> Option<&'static [Need]> {
        Some(&[Need::Incidence])
    }

    fn reads(&self) -> Reads {
        Reads::SURFACES
    }

    fn on_scan(&self, scan: &mut Scan, frame: &FrameContext, draws: &Draws) {
        let boxes = boxes(frame);
        let x = |cos: f64| if self.scale == CosineScale::Log { cos.max(1e-4).ln() } else { cos };
        let half = if self.scale == CosineScale::Log { self.cos_half.ln() } else { self.cos_half };
        // The logistic function to the power of the skew is one half at `cos_half`.
        let middle = half + (0.5f64.powf(-1.0 / self.skew) - 1.0).ln() / self.steepness;
        drop_some(scan, draws, |echo| {
            let x = x(echo.cos_incidence.into());
            let by_law = factor(self.form.as_ref(), x)
                * self.most
                * (1.0 + (-self.steepness * (x - middle)).exp()).powf(-self.skew);
            let estimated = self.estimated_incidence.as_ref();
            (1.0 - estimated.map_or(by_law, |e| e.kept(echo, &boxes, by_law, x))) as f32
        });
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn it_depends_on_the_angle_alone() {
        let effect = IncidenceDropout {
            cos_half: 0.2,
            steepness: 20.0,
            scale: CosineScale::Linear,
            skew: 1.0,
            most: 1.0,
            form: None,
            estimated_incidence: None,
        };
        for (range_m, c) in [(10.0, 0.2), (90.0, 0.2), (10.0, 0.1), (10.0, 0.4)] {
            let mut before = plate(20_000, range_m, 0.5);
            before.echoes.iter_mut().for_each(|e| e.cos_incidence = c);
            let want = 1.0 / (1.0 + (20.0 * (f64::from(c) - 0.2)).exp());
            let got = lost(&before, &applied(&effect, &before));
            assert!((got - want).abs() < 0.012, "{c}: {got} {want}");
        }
    }
}
