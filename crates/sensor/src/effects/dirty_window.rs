//! B8: a dirty spot on a sensor's window.

use super::{Draws, FrameContext, Reads, SensorEffect};
use crate::scan::Scan;
use data::KeyError;
use data::toml_text::within;
use nalgebra::Vector3;
use rand::RngExt;
use rand_distr::{Distribution, StandardNormal};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The one-way transmission of the window is `T = 1 - (1 - transmission) * exp(-(psi / radius_deg)^4)` at angle psi
/// from the centre of the spot. Returned light is multiplied by `T^2`. A return is lost with probability
/// `loss * (1 - T^2)`. The range error is `noise_m * (1 / T - 1) * N(0, 1)`, m. Directions with T above 0.999 are not
/// changed.
///
/// Typical: transmission 0.1 to 0.7 in a spot of 2 to 10 degrees, loss 0.8, noise_m 0.02.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct DirtyWindow {
    /// Name of the sensor; empty for none.
    pub sensor: String,
    /// Azimuth of the centre of the spot, degrees counter-clockwise from the sensor's x axis.
    pub azimuth_deg: f64,
    /// Elevation of the centre of the spot in the sensor's frame, degrees.
    pub elevation_deg: f64,
    /// Radius of the spot, degrees.
    pub radius_deg: f64,
    /// One-way transmission at the centre of the spot, 0.01 to 1.
    pub transmission: f64,
    /// Probability of a loss in the limit T = 0, 0 to 1.
    pub loss: f64,
    /// Standard deviation of the range error where T = 0.5, m.
    pub noise_m: f64,
}

impl Default for DirtyWindow {
    fn default() -> Self {
        DirtyWindow {
            sensor: String::new(),
            azimuth_deg: 20.0,
            elevation_deg: -3.0,
            radius_deg: 6.0,
            transmission: 1.0,
            loss: 0.0,
            noise_m: 0.0,
        }
    }
}

impl SensorEffect for DirtyWindow {
    fn sensor(&self) -> &str {
        &self.sensor
    }

    fn check(&self) -> Result<(), KeyError> {
        within("azimuth_deg", self.azimuth_deg, -180.0, 180.0)?;
        within("elevation_deg", self.elevation_deg, -90.0, 90.0)?;
        within("radius_deg", self.radius_deg, 0.01, 180.0)?;
        within("transmission", self.transmission, 0.01, 1.0)?;
        within("loss", self.loss, 0.0, 1.0)?;
        within("noise_m", self.noise_m, 0.0, 10.0)
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn on_scan(&self, scan: &mut Scan, frame: &FrameContext, draws: &Draws) {
        let Some(number) = frame.rig.find(&self.sensor) else { return };
        let [azimuth, elevation] = [self.azimuth_deg, self.elevation_deg].map(f64::to_radians);
        let middle =
            frame.rig.sensors[number].pose().rotation * Vector3::from(crate::rig::direction(azimuth, elevation));
        let middle: [f32; 3] = middle.map(|v| v as f32).into();
        let radius = self.radius_deg.to_radians() as f32;
        let mut random = draws.of_frame();
        for echo in scan.returns_mut().filter(|e| usize::from(e.sensor) == number) {
            let psi = crate::scan::dot(echo.direction, middle).clamp(-1.0, 1.0).acos();
            let passes = 1.0 - (1.0 - self.transmission as f32) * (-(psi / radius).powi(4)).exp();
            if passes > 0.999 {
                continue;
            }
            echo.returned *= passes * passes;
            let noise: f32 = StandardNormal.sample(&mut random);
            echo.add_range(self.noise_m as f32 * (1.0 / passes - 1.0) * noise);
            if random.random_range(0.0..1.0_f32) < self.loss as f32 * (1.0 - passes * passes) {
                echo.lose();
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn losses_are_limited_to_the_spot_in_the_sensor_s_frame() {
        let before = scene();
        let effect = DirtyWindow {
            sensor: "front".into(),
            azimuth_deg: 20.0,
            elevation_deg: -5.0,
            radius_deg: 6.0,
            transmission: 0.5,
            loss: 1.0,
            noise_m: 0.1,
        };
        let after = applied(&effect, &before);
        let share = |low: f64, high: f64| {
            let inside = |d: [f32; 3]| {
                let (az, el) = (f64::from(d[1].atan2(d[0])).to_degrees(), f64::from(d[2].asin()).to_degrees());
                (low..high).contains(&(az - 20.0).hypot(el + 5.0))
            };
            let all: Vec<_> =
                before.echoes.iter().zip(&after.echoes).filter(|(a, _)| a.is_return() && inside(a.direction)).collect();
            all.iter().filter(|(_, b)| !b.is_return()).count() as f64 / all.len() as f64
        };
        let (inner, outer) = (share(0.0, 3.0), share(10.0, 20.0));
        assert!((inner - 0.75).abs() < 0.08 && outer == 0.0, "{inner} {outer}");
        let other = DirtyWindow { sensor: "rear".into(), ..effect };
        assert_eq!(applied(&other, &before), before, "a sensor that is not in the rig");
    }
}
