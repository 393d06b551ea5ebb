//! D4: spray or dust behind other cars.

use super::{Draws, FrameContext, LabelledCar, Need, SensorEffect};
use crate::scan::{Echo, Scan};
use data::KeyError;
use data::toml_text::within;
use geometry::Box3;
use rand::RngExt;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Behind every other car is a plume as wide as the car, `length_m` long and `height_m` high. A shot whose path within
/// a plume is w long, m, before its surface, reports a droplet with probability `1 - exp(-density_per_m * w)`. The
/// droplet's distance r from the point of entry has a density proportional to `exp(-density_per_m * r)`.
///
/// With `at_speed_m_s` the density is that behind a car of this speed. It grows with the square of the speed, and a car
/// that stands, or whose speed is not known, has no plume.
///
/// Typical: 0.01 to 0.2 per metre on a wet road at speed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Spray {
    /// Probability density of a droplet return along the path, 1/m.
    pub density_per_m: f64,
    /// Speed of a car with that density, m/s; 0 where all cars have it.
    pub at_speed_m_s: f64,
    /// Length of the plume, m.
    pub length_m: f64,
    /// Height of the plume, m.
    pub height_m: f64,
}

impl Default for Spray {
    fn default() -> Self {
        Spray { density_per_m: 0.0, at_speed_m_s: 0.0, length_m: 12.0, height_m: 1.5 }
    }
}

impl SensorEffect for Spray {
    fn check(&self) -> Result<(), KeyError> {
        within("density_per_m", self.density_per_m, 0.0, 100.0)?;
        within("at_speed_m_s", self.at_speed_m_s, 0.0, 200.0)?;
        within("length_m", self.length_m, 0.01, 200.0)?;
        within("height_m", self.height_m, 0.01, 20.0)
    }

    fn needs(&self) -> Option<&'static [Need]> {
        Some(if self.at_speed_m_s > 0.0 { &[Need::Cars, Need::Motion] } else { &[Need::Cars] })
    }

    fn on_scan(&self, scan: &mut Scan, frame: &FrameContext, draws: &Draws) {
        let plumes: Vec<(Box3, f32)> =
            frame.cars.iter().map(|car| (self.plume(&car.true_box), self.density(car) as f32)).collect();
        let mut random = draws.of_frame();
        for echo in &mut scan.echoes {
            for (plume, density) in plumes.iter().filter(|(_, density)| *density > 0.0) {
                let Some([near, far]) = path_through(plume, echo) else {
                    continue;
                };
                let passed = (-density * (far - near)).exp();
                let (chance, part) = (random.random_range(0.0..1.0_f32), random.random_range(0.0..1.0_f32));
                if chance < 1.0 - passed {
                    echo.range_m = near - (1.0 - part * (1.0 - passed)).ln() / density;
                    (echo.returned, echo.reflectivity, echo.object) = (0.05, 0.05, 0);
                }
            }
        }
    }
}

impl Spray {
    /// Density behind a car, 1/m.
    fn density(&self, car: &LabelledCar) -> f64 {
        let [x, y, _] = car.velocity;
        let times = if self.at_speed_m_s > 0.0 { (x.hypot(y) / self.at_speed_m_s).powi(2) } else { 1.0 };
        self.density_per_m * times
    }

    fn plume(&self, car: &Box3) -> Box3 {
        let bottom = -car.size[2] / 2.0;
        let back = -(car.size[0] + self.length_m) / 2.0;
        let center = car.from_local([back, 0.0, bottom + self.height_m / 2.0]);
        Box3 { center, size: [self.length_m, car.size[1], self.height_m], yaw_rad: car.yaw_rad }
    }
}

/// Ranges at which the path of an echo enters and leaves a box, limited to its own, m.
fn path_through(b: &Box3, echo: &Echo) -> Option<[f32; 2]> {
    let path = b.path_through(echo.origin.map(f64::from), echo.direction.map(f64::from), echo.range_m.into());
    path.map(|ends| ends.map(|m| m as f32))
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn droplets_are_within_the_plume() {
        let effect = Spray { density_per_m: 0.2, length_m: 8.0, height_m: 2.0, ..Spray::default() };
        let before = scene();
        let after = applied(&effect, &before);
        let plume = effect.plume(&cars()[0].true_box);
        let changed: Vec<_> = before.echoes.iter().zip(&after.echoes).filter(|(a, b)| a.range_m != b.range_m).collect();
        assert!(changed.len() > 20, "{}", changed.len());
        for (_, b) in &changed {
            let local = plume.to_local(b.point().map(f64::from));
            assert!((0..3).all(|k| local[k].abs() <= plume.size[k] / 2.0 + 1e-3), "{local:?}");
        }
        // A fraction 1 - exp(-0.2 w) of the shots with a path of w m within the plume report a droplet.
        let through = |e: &Echo| path_through(&plume, e);
        let expected: f64 =
            before.echoes.iter().filter_map(through).map(|[n, f]| 1.0 - f64::from((-0.2 * (f - n)).exp())).sum();
        assert!((changed.len() as f64 / expected - 1.0).abs() < 0.15, "{} {expected}", changed.len());
    }

    #[test]
    fn the_density_grows_with_the_square_of_the_speed() {
        // The car of the scene drives 60 m/s.
        let at = |at_speed_m_s: f64| Spray { density_per_m: 0.2, at_speed_m_s, ..Spray::default() }.density(&cars()[0]);
        assert!((at(0.0) - 0.2).abs() < 1e-12 && (at(60.0) - 0.2).abs() < 1e-12 && (at(30.0) - 0.8).abs() < 1e-12);
        let standing = LabelledCar { velocity: [0.0; 3], ..cars()[0].clone() };
        let spray = Spray { density_per_m: 0.2, at_speed_m_s: 10.0, ..Spray::default() };
        assert_eq!(spray.density(&standing), 0.0);
        assert_eq!(spray.needs(), Some(&[Need::Cars, Need::Motion][..]));
    }
}
