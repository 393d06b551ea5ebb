//! D4: fog: attenuation and backscatter.

use super::{Draws, FrameContext, Need, SensorEffect};
use crate::scan::Scan;
use data::KeyError;
use data::toml_text::within;
use rand::RngExt;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The extinction coefficient is `alpha = ln(20) / visibility_m`, 1/m. The light of a return at range R is multiplied
/// by `exp(-2 alpha R)`. With probability `backscatter * (1 - exp(-2 alpha R))`, a shot reports a droplet instead of
/// the surface. The range r of the droplet has a density proportional to `exp(-2 alpha r)` between 1 m and R. For shots
/// without a return, R is `reach_m`.
///
/// Typical: visibility 50 m (alpha 0.06, dense) to 1000 m (Hahner et al. 2021); backscatter 0.01 to 0.3 (0.05). Fog
/// attenuates the light but does not remove returns: put a detection threshold ([`super::SignalDropout`]) behind it in
/// the list.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Fog {
    /// Meteorological optical range, m.
    pub visibility_m: f64,
    /// Probability factor of droplet returns, 0 to 1.
    #[serde(default)]
    pub backscatter: f64,
    /// Maximum range of droplets for shots without a return, m.
    #[serde(default = "usual_reach_m")]
    pub reach_m: f64,
}

fn usual_reach_m() -> f64 {
    50.0
}

impl SensorEffect for Fog {
    fn check(&self) -> Result<(), KeyError> {
        within("visibility_m", self.visibility_m, 1.0, 1e6)?;
        within("backscatter", self.backscatter, 0.0, 1.0)?;
        within("reach_m", self.reach_m, 1.0, 1000.0)
    }

    fn needs(&self) -> Option<&'static [Need]> {
        Some(&[Need::Reflectivity])
    }

    fn on_scan(&self, scan: &mut Scan, _frame: &FrameContext, draws: &Draws) {
        let alpha = (20_f32).ln() / self.visibility_m as f32;
        let mut random = draws.of_frame();
        for echo in &mut scan.echoes {
            let free_m = if echo.is_return() { echo.range_m } else { self.reach_m as f32 };
            echo.returned *= (-2.0 * alpha * free_m).exp();
            let behind = (-2.0 * alpha * free_m).exp();
            let (chance, part) = (random.random_range(0.0..1.0_f32), random.random_range(0.0..1.0_f32));
            if free_m > 1.0 && chance < self.backscatter as f32 * (1.0 - behind) {
                // Inverse of the cumulative distribution between 1 m and the surface.
                let first = (-2.0 * alpha).exp();
                echo.range_m = -(first - part * (first - behind)).ln() / (2.0 * alpha);
                (echo.returned, echo.reflectivity, echo.object) = (0.02, 0.02, 0);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn light_is_attenuated_and_droplets_follow_the_density() {
        let before = plate(40_000, 60.0, 0.5);
        let effect = Fog { visibility_m: 60.0, backscatter: 0.2, reach_m: 30.0 };
        let after = applied(&effect, &before);
        let alpha = 20_f64.ln() / 60.0;
        let kept = after.echoes.iter().find(|e| e.range_m == 60.0).unwrap();
        assert!((f64::from(kept.returned) / 0.5 / (-120.0 * alpha).exp() - 1.0).abs() < 1e-3);
        let droplets: Vec<f64> = after.echoes.iter().filter(|e| e.range_m != 60.0).map(|e| e.range_m.into()).collect();
        let share = droplets.len() as f64 / 40_000.0;
        assert!((share - 0.2 * (1.0 - (-120.0 * alpha).exp())).abs() < 0.01, "{share}");
        // Exponential from 1 m on: the mean is 1 / (2 alpha) beyond that.
        let (mean, _) = moments(&droplets);
        assert!((mean - 1.0 - 0.5 / alpha).abs() < 0.3, "{mean}");
        let mut sky = before;
        sky.echoes.iter_mut().for_each(|e| e.lose());
        assert!(applied(&effect, &sky).returns().all(|e| (1.0..=30.0).contains(&e.range_m)));
    }
}
