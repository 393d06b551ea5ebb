//! A3: range noise that grows as less light returns.

use super::assumed::{AssumedReflectivity, boxes, signal as own_signal};
use super::range_noise::add_noise;
use super::{Draws, FrameContext, Need, Reads, SensorEffect};
use crate::scan::{Echo, Scan};
use data::KeyError;
use data::toml_text::within;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// `s * N(0, 1)`, m, is added to a range R, with `s = min(std_m * exp(-exponent * (u - signal)), most_m)`, u the signal
/// index `ln(returned / R^2) - ln(0.1 / 250^2)`. The standard deviation is `std_m` where u equals `signal`, and larger
/// where less light returns.
///
/// Typical: std_m 0.02 at signal 3, exponent 0.5 to 0.8, most_m 0.3 (Ouster OS1's data sheet: 1.5 cm at a
/// signal-to-noise ratio of 250, 3 cm at 100, 10 cm at 12).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RangeNoiseBySignal {
    /// Standard deviation at the reference signal index, m.
    pub std_m: f64,
    /// Growth exponent: s is proportional to the returned light to the power of `-exponent`.
    pub exponent: f64,
    /// Reference signal index. 0 is the light at the data sheet's maximum range (250 m at 10 % reflectivity), 4.6 a
    /// hundred times that light.
    pub signal: f64,
    /// Upper limit of the standard deviation, m.
    pub most_m: f64,
    /// Reflectivities that are assumed in place of the surfaces' own; without them the surfaces' own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub assumed: Option<AssumedReflectivity>,
}

impl Default for RangeNoiseBySignal {
    fn default() -> Self {
        RangeNoiseBySignal { std_m: 0.0, exponent: 0.57, signal: 3.0, most_m: 10.0, assumed: None }
    }
}

impl SensorEffect for RangeNoiseBySignal {
    fn check(&self) -> Result<(), KeyError> {
        within("std_m", self.std_m, 0.0, 10.0)?;
        within("exponent", self.exponent, 0.0, 5.0)?;
        within("signal", self.signal, -20.0, 20.0)?;
        self.assumed.map_or(Ok(()), |assumed| assumed.check())?;
        within("most_m", self.most_m, self.std_m, 10.0)
    }

    fn needs(&self) -> Option<&'static [Need]> {
        Some(if self.assumed.is_some() { &[Need::Incidence] } else { &[Need::Incidence, Need::Reflectivity] })
    }

    fn reads(&self) -> Reads {
        Reads::SURFACES
    }

    fn on_scan(&self, scan: &mut Scan, frame: &FrameContext, draws: &Draws) {
        let [std, exponent, signal, most] = [self.std_m, self.exponent, self.signal, self.most_m].map(|v| v as f32);
        let boxes = boxes(frame);
        let index = |echo: &Echo| own_signal(self.assumed.as_ref(), echo, &boxes);
        add_noise(scan, draws, |echo| (std * (-exponent * (index(echo) - signal)).exp()).min(most));
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn the_deviation_follows_the_signal() {
        let effect = RangeNoiseBySignal { std_m: 0.02, exponent: 0.5, signal: 0.0, most_m: 0.1, assumed: None };
        // At exponent 0.5, a hundredth of the light gives ten times the noise, up to the limit.
        for (range_m, reflectivity, want) in
            [(250.0, 0.1, 0.02), (25.0, 0.1, 0.002), (250.0, 0.01, 0.0632), (250.0, 1e-4, 0.1)]
        {
            let before = plate(20_000, range_m, reflectivity);
            let (_, std) = moments(&residuals(&before, &applied(&effect, &before)));
            assert!((std / want - 1.0).abs() < 0.04, "{range_m} {reflectivity}: {std} {want}");
        }
    }

    #[test]
    fn what_is_assumed_replaces_the_surfaces_own_light() {
        let noise = |assumed| RangeNoiseBySignal { std_m: 0.02, exponent: 0.5, signal: 0.0, most_m: 1.0, assumed };
        let before = plate(20_000, 50.0, 0.8);
        let of = |effect: &RangeNoiseBySignal| {
            let after = applied(effect, &before);
            let squares: f32 = after.echoes.iter().map(|e| (e.range_m - 50.0).powi(2)).sum();
            (squares / after.echoes.len() as f32).sqrt()
        };
        let (own, dark) = (of(&noise(None)), of(&noise(Some(AssumedReflectivity::even(0.1)))));
        assert!((dark / own - 8f32.sqrt()).abs() < 0.05, "{dark} {own}");
        assert_eq!(noise(Some(AssumedReflectivity::even(0.1))).needs(), Some(&[Need::Incidence][..]));
    }
}
