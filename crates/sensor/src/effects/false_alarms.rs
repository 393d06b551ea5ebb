//! D5: false returns from receiver noise and sunlight.

use super::{Draws, FrameContext, Reads, SensorEffect};
use crate::scan::Scan;
use data::toml_text::within;
use data::{KeyError, Stream};
use rand::RngExt;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A shot gives a false return with probability `rate + sun_rate * exp(-(d / sun_width_deg)^2)`, d the azimuth
/// difference to the sun. Its range follows `law`. It is reported only if it is between 0.1 m and `reach_m`, and nearer
/// than the shot's true return, if there is one, or `instead` of it.
///
/// Typical: 1e-4 (the rate to which Ouster's data sheet refers) to 1e-2 towards the sun.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct FalseAlarms {
    /// Probability independent of direction, 0 to 1.
    pub rate: f64,
    /// Additional probability in the direction of the sun, 0 to 1.
    pub sun_rate: f64,
    /// Azimuth of the sun in the world's frame, degrees counter-clockwise from +x (east).
    pub sun_azimuth_deg: f64,
    /// Azimuth difference at which the additional probability has fallen to 1/e, degrees.
    pub sun_width_deg: f64,
    /// Maximum range of false returns, m.
    pub reach_m: f64,
    /// Law of the ranges.
    pub law: RangeLaw,
    /// Mean distance of droplets, m, for the laws `exponential` and `gamma`.
    pub depth_m: f64,
    /// Whether a false return takes the place of a nearer true one as well.
    pub instead: bool,
}

/// Law of the ranges of false returns.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum RangeLaw {
    /// Uniform between 0 and `reach_m`: noise of the receiver.
    #[default]
    Uniform,
    /// Exponential with the mean `depth_m`: droplets in light that they weaken.
    Exponential,
    /// Gamma of shape 2 with the mean `depth_m`: the same, where near droplets are out of the field of view.
    Gamma,
    /// As 1 / r from 0.5 m to `reach_m`: single drops.
    Inverse,
}

impl Default for FalseAlarms {
    fn default() -> Self {
        FalseAlarms {
            rate: 0.0,
            sun_rate: 0.0,
            sun_azimuth_deg: -60.0,
            sun_width_deg: 15.0,
            reach_m: 200.0,
            law: RangeLaw::Uniform,
            depth_m: 0.0,
            instead: false,
        }
    }
}

impl SensorEffect for FalseAlarms {
    fn check(&self) -> Result<(), KeyError> {
        within("rate", self.rate, 0.0, 1.0)?;
        within("sun_rate", self.sun_rate, 0.0, 1.0)?;
        within("sun_azimuth_deg", self.sun_azimuth_deg, -360.0, 360.0)?;
        within("sun_width_deg", self.sun_width_deg, 0.1, 360.0)?;
        within("reach_m", self.reach_m, 0.1, 5000.0)?;
        let least_m = if matches!(self.law, RangeLaw::Exponential | RangeLaw::Gamma) { 0.1 } else { 0.0 };
        within("depth_m", self.depth_m, least_m, 5000.0)
    }

    fn reads(&self) -> Reads {
        Reads::EMPTY_SHOTS
    }

    fn on_scan(&self, scan: &mut Scan, frame: &FrameContext, draws: &Draws) {
        let sun = (self.sun_azimuth_deg.to_radians() + frame.world_x_rad) as f32;
        let width = self.sun_width_deg.to_radians() as f32;
        let mut random = draws.of_frame();
        for echo in &mut scan.echoes {
            let mut rate = self.rate as f32;
            if self.sun_rate > 0.0 {
                let off = echo.direction[1].atan2(echo.direction[0]) - sun;
                let off = off.sin().atan2(off.cos());
                rate += self.sun_rate as f32 * (-(off / width).powi(2)).exp();
            }
            let (chance, part) = (random.random_range(0.0..1.0_f32), random.random_range(0.0..1.0_f32));
            let range_m = self.range_m(part, &mut random);
            let seen = range_m > 0.1 && range_m <= self.reach_m as f32;
            if chance < rate && (self.instead || range_m < echo.range_m) && seen {
                *echo = crate::scan::Echo {
                    range_m,
                    normal: [0.0; 3],
                    reflectivity: 0.02,
                    returned: 0.02,
                    object: 0,
                    ..*echo
                };
            }
        }
    }
}

/// Nearest range of single drops, m.
pub const FIRST_DROP_M: f32 = 0.5;

impl FalseAlarms {
    /// Range of a false return, m, by a number that is uniform between 0 and 1; the gamma law draws another one.
    fn range_m(&self, uniform: f32, random: &mut Stream) -> f32 {
        let (reach_m, depth_m) = (self.reach_m as f32, self.depth_m as f32);
        match self.law {
            RangeLaw::Uniform => reach_m * uniform,
            RangeLaw::Exponential => -depth_m * (1.0 - uniform).ln(),
            RangeLaw::Gamma => {
                let other = random.random_range(0.0..1.0_f32);
                -0.5 * depth_m * ((1.0 - uniform) * (1.0 - other)).max(1e-12).ln()
            }
            RangeLaw::Inverse => FIRST_DROP_M * (reach_m.max(FIRST_DROP_M) / FIRST_DROP_M).powf(uniform),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn false_returns_are_uniform_in_range() {
        let mut before = plate(40_000, 100.0, 0.5);
        before.echoes.iter_mut().for_each(|e| e.lose());
        let effect = FalseAlarms { rate: 0.05, reach_m: 200.0, ..FalseAlarms::default() };
        let ranges: Vec<f64> = applied(&effect, &before).returns().map(|e| e.range_m.into()).collect();
        let share = ranges.len() as f64 / 40_000.0;
        let (mean, std) = moments(&ranges);
        assert!((share - 0.05).abs() < 0.004, "{share}");
        assert!((mean - 100.0).abs() < 5.0 && (std - 200.0 / 12_f64.sqrt()).abs() < 4.0, "{mean} {std}");
    }

    #[test]
    fn droplets_are_ever_fewer_with_range() {
        let mut before = plate(40_000, 100.0, 0.5);
        before.echoes.iter_mut().for_each(|e| e.lose());
        // Mean and standard deviation of each law.
        let (inverse_mean, inverse_square) = (19.5 / 40f64.ln(), (400.0 - 0.25) / 2.0 / 40f64.ln());
        let inverse = [inverse_mean, (inverse_square - inverse_mean.powi(2)).sqrt()];
        for (law, reach_m, want) in [
            (RangeLaw::Exponential, 200.0, [12.0, 12.0]),
            (RangeLaw::Gamma, 200.0, [12.0, 12.0 / 2f64.sqrt()]),
            (RangeLaw::Inverse, 20.0, inverse),
        ] {
            let effect = FalseAlarms { rate: 0.1, law, depth_m: 12.0, reach_m, ..FalseAlarms::default() };
            let ranges: Vec<f64> = applied(&effect, &before).returns().map(|e| e.range_m.into()).collect();
            let (mean, std) = moments(&ranges);
            assert!((mean / want[0] - 1.0).abs() < 0.05 && (std / want[1] - 1.0).abs() < 0.07, "{law:?} {mean} {std}");
            let near = FalseAlarms { reach_m: 10.0, ..effect };
            assert!(applied(&near, &before).returns().all(|e| e.range_m <= 10.001));
        }
    }

    #[test]
    fn false_returns_concentrate_towards_the_sun() {
        let mut before = scene();
        before.echoes.iter_mut().for_each(|e| e.lose());
        let effect = FalseAlarms {
            rate: 0.0,
            sun_rate: 0.5,
            sun_azimuth_deg: 30.0,
            sun_width_deg: 10.0,
            ..FalseAlarms::default()
        };
        let azimuths: Vec<f64> = applied(&effect, &before)
            .returns()
            .map(|e| f64::from(e.direction[1].atan2(e.direction[0])).to_degrees())
            .collect();
        let (mean, std) = moments(&azimuths);
        assert!((mean - 30.0).abs() < 1.0 && (std - 10.0 / 2_f64.sqrt()).abs() < 1.0, "{mean} {std}");
    }
}
