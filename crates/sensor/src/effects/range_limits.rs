//! B6: minimum and maximum range.

use super::{Draws, FrameContext, Reads, SensorEffect};
use crate::scan::Scan;
use data::KeyError;
use data::toml_text::within;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Returns outside of `min_m..=max_m` are lost.
///
/// Typical: minimum 0.3 to 1 m (Ouster OS1 0.8 m), maximum 100 to 250 m.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RangeLimits {
    /// Minimum range, m.
    pub min_m: f64,
    /// Maximum range, m.
    pub max_m: f64,
}

impl Default for RangeLimits {
    fn default() -> Self {
        RangeLimits { min_m: 0.0, max_m: 1e4 }
    }
}

impl SensorEffect for RangeLimits {
    fn check(&self) -> Result<(), KeyError> {
        within("max_m", self.max_m, 0.0, 1e4)?;
        within("min_m", self.min_m, 0.0, self.max_m)
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn on_scan(&self, scan: &mut Scan, _frame: &FrameContext, _draws: &Draws) {
        let limits = self.min_m as f32..=self.max_m as f32;
        for echo in scan.returns_mut().filter(|e| !limits.contains(&e.range_m)) {
            echo.lose();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn returns_outside_of_the_limits_are_lost() {
        let before = scene();
        let after = applied(&RangeLimits { min_m: 10.0, max_m: 30.0 }, &before);
        for (a, b) in before.echoes.iter().zip(&after.echoes) {
            assert_eq!(b.is_return(), a.is_return() && (10.0..=30.0).contains(&a.range_m));
        }
        assert!((0.1..0.9).contains(&lost(&before, &after)));
    }
}
