//! A6: an offset and a scale error of all ranges.

use super::{Draws, FrameContext, Reads, SensorEffect};
use crate::scan::Scan;
use data::KeyError;
use data::toml_text::within;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A range R becomes `R * (1 + scale) + offset_m`, m.
///
/// Typical: offset of millimetres to centimetres (0.02); scale 1e-4 to 1e-3.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RangeBias {
    /// Offset, m.
    pub offset_m: f64,
    /// Scale error, m per m of range.
    pub scale: f64,
}

impl SensorEffect for RangeBias {
    fn check(&self) -> Result<(), KeyError> {
        within("offset_m", self.offset_m, -10.0, 10.0)?;
        within("scale", self.scale, -0.5, 0.5)
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn on_scan(&self, scan: &mut Scan, _frame: &FrameContext, _draws: &Draws) {
        if *self == RangeBias::default() {
            return;
        }
        for echo in scan.returns_mut() {
            let range_m = f64::from(echo.range_m);
            echo.range_m = (range_m * (1.0 + self.scale) + self.offset_m).max(0.01) as f32;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn the_error_is_linear_in_range() {
        for range_m in [5.0, 100.0] {
            let before = plate(10, range_m, 0.5);
            let off = residuals(&before, &applied(&RangeBias { offset_m: -0.05, scale: 0.001 }, &before));
            assert!(off.iter().all(|v| (v + 0.05 - 0.001 * f64::from(range_m)).abs() < 1e-5), "{off:?}");
        }
    }
}
