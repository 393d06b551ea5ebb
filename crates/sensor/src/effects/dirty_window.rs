//! B8: a dirty spot on a sensor's window.

use super::{Draws, FrameContext, Reads, SensorEffect};
use crate::scan::{Scan, dot};
use data::KeyError;
use data::toml_text::within;
use nalgebra::Vector3;
use rand::RngExt;
use rand_distr::{Distribution, StandardNormal};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The one-way transmission of the window is `T = 1 - (1 - transmission) * exp(-(psi / radius_deg)^sharpness)` at
/// angle psi from the centre of the spot; horizontal parts of psi are divided by `aspect` first. Returned light is
/// multiplied by `T^2`. A return is lost with probability `loss * (1 - T^2)`. The range error is
/// `noise_m * (1 / T - 1) * N(0, 1)`, m. Directions with T above 0.999 are not changed.
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
    /// Radius of the spot along elevation, degrees.
    pub radius_deg: f64,
    /// Width of the spot over its height, 0.05 to 20.
    pub aspect: f64,
    /// Exponent of the profile, 1 to 20: 2 is a soft edge, 8 a sharp one.
    pub sharpness: f64,
    /// One-way transmission at the centre of the spot, 0.01 to 1.
    pub transmission: f64,
    /// Probability of a loss in the limit T = 0, 0 to 1.
    pub loss: f64,
    /// Standard deviation of the range error where T = 0.5, m.
    pub noise_m: f64,
}

impl DirtyWindow {
    /// Smallest and largest aspect of a spot.
    pub const ASPECT: [f64; 2] = [0.05, 20.0];
}

impl Default for DirtyWindow {
    fn default() -> Self {
        DirtyWindow {
            sensor: String::new(),
            azimuth_deg: 20.0,
            elevation_deg: -3.0,
            radius_deg: 6.0,
            aspect: 1.0,
            sharpness: 4.0,
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
        let [narrowest, widest] = Self::ASPECT;
        within("aspect", self.aspect, narrowest, widest)?;
        within("sharpness", self.sharpness, 1.0, 20.0)?;
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
        let rotation = frame.rig.sensors[number].pose().rotation;
        let in_vehicle = |v: [f64; 3]| -> [f32; 3] { (rotation * Vector3::from(v)).map(|v| v as f32).into() };
        let middle = in_vehicle(crate::rig::direction(azimuth, elevation));
        let left = in_vehicle([-azimuth.sin(), azimuth.cos(), 0.0]);
        let (radius, sharpness) = (self.radius_deg.to_radians() as f32, self.sharpness as f32);
        // What the square of an angle to the side of the centre loses, since it is divided by the aspect.
        let narrowing = 1.0 - (self.aspect as f32).powi(-2);
        let mut random = draws.of_frame();
        for echo in scan.returns_mut().filter(|e| usize::from(e.sensor) == number) {
            let (along, side) = (dot(echo.direction, middle).clamp(-1.0, 1.0), dot(echo.direction, left));
            let to_the_side = side * side / (1.0 - along * along).max(1e-12);
            let psi = along.acos() * (1.0 - narrowing * to_the_side.min(1.0)).sqrt();
            let passes = 1.0 - (1.0 - self.transmission as f32) * (-(psi / radius).powf(sharpness)).exp();
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
            aspect: 1.0,
            sharpness: 4.0,
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
        let wide = applied(&DirtyWindow { aspect: 2.0, ..effect.clone() }, &before);
        let lost_at = |scan: &Scan, side: bool| {
            let both = before.echoes.iter().zip(&scan.echoes).filter(|(a, b)| a.is_return() && !b.is_return());
            let off = both.map(|(a, _)| {
                let d = a.direction;
                let (az, el) = (f64::from(d[1].atan2(d[0])).to_degrees(), f64::from(d[2].asin()).to_degrees());
                if side { (az - 20.0).abs() } else { (el + 5.0).abs() }
            });
            off.fold(0.0, f64::max)
        };
        assert!(lost_at(&wide, true) > 1.6 * lost_at(&after, true), "twice as wide");
        assert!(lost_at(&wide, false) < 1.2 * lost_at(&after, false), "as high");
        let other = DirtyWindow { sensor: "rear".into(), ..effect };
        assert_eq!(applied(&other, &before), before, "a sensor that is not in the rig");
    }
}
