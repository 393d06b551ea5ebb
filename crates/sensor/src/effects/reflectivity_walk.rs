//! A8: range walk, a range error that depends on reflectivity.

use super::{Draws, FrameContext, Need, Reads, SensorEffect};
use crate::scan::Scan;
use data::KeyError;
use data::toml_text::within;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// `walk_m * ln(reflectivity / reference)`, m, is added to each range. The edge of a strong pulse crosses the detection
/// threshold earlier, so `walk_m` is negative for a receiver without compensation.
///
/// Typical: -0.5 to -3 cm per factor e of reflectivity; "slight bias for retro-reflectors" in data sheets.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ReflectivityWalk {
    /// Change of range per factor e of reflectivity, m.
    pub walk_m: f64,
    /// Reflectivity at which the error is 0.
    pub reference: f64,
}

impl Default for ReflectivityWalk {
    fn default() -> Self {
        ReflectivityWalk { walk_m: 0.0, reference: 0.3 }
    }
}

impl SensorEffect for ReflectivityWalk {
    fn check(&self) -> Result<(), KeyError> {
        within("walk_m", self.walk_m, -1.0, 1.0)?;
        within("reference", self.reference, 1e-3, 1000.0)
    }

    fn needs(&self) -> Option<&'static [Need]> {
        Some(&[Need::Reflectivity])
    }

    fn reads(&self) -> Reads {
        Reads::SURFACES
    }

    fn on_scan(&self, scan: &mut Scan, _frame: &FrameContext, _draws: &Draws) {
        for echo in scan.returns_mut().filter(|e| e.reflectivity > 0.0) {
            let walk = self.walk_m * (f64::from(echo.reflectivity) / self.reference).ln();
            echo.add_range(walk as f32);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn bright_surfaces_appear_nearer() {
        for (reflectivity, want) in [(0.2, 0.0), (20.0, -0.0921), (0.02, 0.0461)] {
            let before = plate(5, 30.0, reflectivity);
            let off = residuals(&before, &applied(&ReflectivityWalk { walk_m: -0.02, reference: 0.2 }, &before));
            assert!((off[0] - want).abs() < 1e-4, "{reflectivity}: {} {want}", off[0]);
        }
    }
}
