//! B2: detection probability by returned light (LiDAR equation).

use super::assumed::{AssumedReflectivity, boxes, signal};
use super::form::{EstimatedIncidence, Form, factor};
use super::random_dropout::drop_some;
use super::{Draws, FrameContext, Need, Reads, SensorEffect};
use crate::scan::Scan;
use data::KeyError;
use data::toml_text::within;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A return at range R, m, is detected with probability `most * (1 + exp(-steepness * (u - u0)))^-skew`. It is half of
/// `most` at the index `threshold`, which gives u0. The signal index u is
/// `ln(returned / R^2) - ln(0.1 / 250^2) - 2 * attenuation_per_m * R`.
///
/// Typical: threshold 0 is the data sheet's maximum range (250 m at 10 % reflectivity); -2 to 3; steepness 2 to 8.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SignalDropout {
    /// Detection probability at strong signals, 0 to 1.
    #[serde(default = "all_detected")]
    pub most: f64,
    /// Signal index at which the detection probability is half of `most`.
    pub threshold: f64,
    /// Steepness of the logistic function, per unit of the signal index.
    pub steepness: f64,
    /// Exponent of the logistic function, which lets its two tails differ; 1 for none.
    #[serde(default = "all_detected")]
    pub skew: f64,
    /// Extinction coefficient of the air, one way, 1/m.
    #[serde(default)]
    pub attenuation_per_m: f64,
    /// Reflectivities that are assumed in place of the surfaces' own; without them the surfaces' own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub assumed: Option<AssumedReflectivity>,
    /// Correction of the form over the signal index.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub form: Option<Form>,
    /// What is lost in finished clouds, whose angles of incidence are estimated; factors over the signal index.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub estimated_incidence: Option<Box<EstimatedIncidence>>,
}

fn all_detected() -> f64 {
    1.0
}

impl SensorEffect for SignalDropout {
    fn check(&self) -> Result<(), KeyError> {
        within("most", self.most, 0.0, 1.0)?;
        within("threshold", self.threshold, -20.0, 20.0)?;
        within("steepness", self.steepness, 0.01, 100.0)?;
        within("skew", self.skew, 0.01, 100.0)?;
        self.assumed.map_or(Ok(()), |assumed| assumed.check())?;
        self.form.as_ref().map_or(Ok(()), Form::check)?;
        self.estimated_incidence.as_ref().map_or(Ok(()), |estimated| estimated.check())?;
        within("attenuation_per_m", self.attenuation_per_m, 0.0, 1.0)
    }

    fn needs(&self) -> Option<&'static [Need]> {
        Some(if self.assumed.is_some() { &[Need::Incidence] } else { &[Need::Incidence, Need::Reflectivity] })
    }

    fn reads(&self) -> Reads {
        Reads::SURFACES
    }

    fn on_scan(&self, scan: &mut Scan, frame: &FrameContext, draws: &Draws) {
        let boxes = boxes(frame);
        // The logistic function to the power of the skew is one half at the threshold.
        let middle = self.threshold + (0.5f64.powf(-1.0 / self.skew) - 1.0).ln() / self.steepness;
        let [most, middle, steepness, skew, attenuation] =
            [self.most, middle, self.steepness, self.skew, self.attenuation_per_m].map(|v| v as f32);
        drop_some(scan, draws, |echo| {
            let signal = signal(self.assumed.as_ref(), echo, &boxes) - 2.0 * attenuation * echo.range_m;
            let form = factor(self.form.as_ref(), signal.into()) as f32;
            let by_law = form * most * (1.0 + (-steepness * (signal - middle)).exp()).powf(-skew);
            let estimated = self.estimated_incidence.as_ref();
            1.0 - estimated.map_or(by_law, |e| e.kept(echo, &boxes, by_law.into(), signal.into()) as f32)
        });
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn detection_depends_on_the_signal_index_alone() {
        let effect = SignalDropout {
            most: 0.9,
            threshold: 0.0,
            steepness: 4.0,
            attenuation_per_m: 0.0,
            skew: 1.0,
            assumed: None,
            form: None,
            estimated_incidence: None,
        };
        let logistic = |u: f64| 1.0 - 0.9 / (1.0 + (-4.0 * u).exp());
        // Twice the range returns a quarter of the light.
        for (range_m, reflectivity, u) in [
            (250.0, 0.1, 0.0),
            (125.0, 0.025, 0.0),
            (250.0, 0.15, 1.5_f64.ln()),
            (500.0, 0.1, -4.0_f64.ln()),
            (50.0, 0.1, 25_f64.ln()),
        ] {
            let before = plate(20_000, range_m, reflectivity);
            let got = lost(&before, &applied(&effect, &before));
            assert!((got - logistic(u)).abs() < 0.015, "{range_m} {reflectivity}: {got} {}", logistic(u));
        }
        let hazy = SignalDropout { attenuation_per_m: 0.01, ..effect };
        let before = plate(20_000, 250.0, 0.1);
        assert!((lost(&before, &applied(&hazy, &before)) - logistic(-5.0)).abs() < 0.01);
    }

    #[test]
    fn skew_form_and_assumed_light() {
        let kept = |effect: &SignalDropout, reflectivity: f32| {
            applied(effect, &plate(20_000, 100.0, reflectivity)).returns().count() as f64 / 20_000.0
        };
        let plain = SignalDropout {
            most: 0.9,
            threshold: 2.0,
            steepness: 3.0,
            attenuation_per_m: 0.0,
            skew: 0.4,
            assumed: None,
            form: None,
            estimated_incidence: None,
        };
        // The reflectivity at which the index is 2: half of `most`, whatever the skew.
        let half = (0.1 * (2f64).exp() * (100.0f64 / 250.0).powi(2)) as f32;
        assert!((kept(&plain, half) - 0.45).abs() < 0.01, "{}", kept(&plain, half));
        let assumed = AssumedReflectivity { ground: 0.9, standing: half.into(), objects: 0.9, wheels: None };
        let assumed = SignalDropout { assumed: Some(assumed), ..plain.clone() };
        assert!((kept(&assumed, 5.0) - 0.45).abs() < 0.01, "a plate stands, whatever its own light");
        let form = Form { at: vec![1.0, 3.0], factor: vec![0.4, 0.8] };
        let formed = SignalDropout { form: Some(form), ..plain };
        assert!((kept(&formed, half) - 0.45 * 0.6).abs() < 0.01);
        let unsorted = Form { at: vec![3.0, 1.0], factor: vec![0.4, 0.8] };
        let error = SignalDropout { form: Some(unsorted), ..formed }.check().unwrap_err().to_string();
        assert!(error.contains("form.at[1]"), "{error}");
    }
}
