//! A2: range noise that grows with range.

use super::range_noise::add_noise;
use super::{Draws, FrameContext, Reads, SensorEffect};
use crate::scan::Scan;
use data::KeyError;
use data::toml_text::within;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// `s * N(0, 1)`, m, is added to a range R, with `s = base_m + per_m * R`, or `s = hypot(base_m, per_m * R)` if
/// `quadratic` is true.
///
/// Typical: base 0.005 to 0.03 m (0.01), 1e-4 to 1e-3 m per m (5e-4; the form of the Unity plugin of Robotec's GPU
/// LiDAR).
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RangeNoiseByRange {
    /// Standard deviation at range 0, m.
    pub base_m: f64,
    /// Growth of the standard deviation per metre of range, m/m.
    pub per_m: f64,
    /// Add the two terms as independent noise, in quadrature.
    pub quadratic: bool,
}

impl SensorEffect for RangeNoiseByRange {
    fn check(&self) -> Result<(), KeyError> {
        within("base_m", self.base_m, 0.0, 10.0)?;
        within("per_m", self.per_m, 0.0, 0.1)
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn on_scan(&self, scan: &mut Scan, _frame: &FrameContext, draws: &Draws) {
        let (base, per) = (self.base_m as f32, self.per_m as f32);
        add_noise(scan, draws, |echo| {
            let grown = per * echo.range_m;
            if self.quadratic { base.hypot(grown) } else { base + grown }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn the_deviation_follows_the_range() {
        for (quadratic, range_m, want) in
            [(false, 10.0, 0.02), (false, 100.0, 0.11), (true, 10.0, 0.014_142), (true, 100.0, 0.1005)]
        {
            let before = plate(20_000, range_m, 0.5);
            let effect = RangeNoiseByRange { base_m: 0.01, per_m: 0.001, quadratic };
            let (mean, std) = moments(&residuals(&before, &applied(&effect, &before)));
            assert!(mean.abs() < 3e-3 && (std / want - 1.0).abs() < 0.03, "{range_m}: {mean} {std} {want}");
        }
    }
}
