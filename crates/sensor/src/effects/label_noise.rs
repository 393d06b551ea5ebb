//! C7: random label errors, new in every frame.

use super::{Draws, FrameContext, LabelledCar, Reads, SensorEffect};
use data::KeyError;
use data::toml_text::within;
use rand::RngExt;
use rand_distr::{Distribution, StandardNormal};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A label is shifted by independent normal errors along its heading, to the left and upwards, and its yaw by another.
/// With probability `slip_probability` it is shifted by another `slip_m` forward or backward, with equal probability.
///
/// Typical: 2 to 5 cm and 0.1 to 0.5 degrees (RTK): 0.05, 0.03 and 0.03 m, 0.2 degrees; shifts of about 0.8 m in some
/// frames (Huch et al. 2023, figure 8).
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct LabelNoise {
    /// Standard deviation along the heading, m.
    pub longitudinal_std_m: f64,
    /// Standard deviation across the heading, m.
    pub lateral_std_m: f64,
    /// Standard deviation of the height, m.
    pub vertical_std_m: f64,
    /// Standard deviation of the yaw, degrees.
    pub yaw_std_deg: f64,
    /// Fraction of the labels with an additional shift, 0 to 1.
    pub slip_probability: f64,
    /// Size of the additional shift along the heading, m.
    pub slip_m: f64,
}

impl SensorEffect for LabelNoise {
    fn check(&self) -> Result<(), KeyError> {
        for (key, value) in [
            ("longitudinal_std_m", self.longitudinal_std_m),
            ("lateral_std_m", self.lateral_std_m),
            ("vertical_std_m", self.vertical_std_m),
            ("slip_m", self.slip_m),
        ] {
            within(key, value, 0.0, 20.0)?;
        }
        within("yaw_std_deg", self.yaw_std_deg, 0.0, 180.0)?;
        within("slip_probability", self.slip_probability, 0.0, 1.0)
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn on_labels(&self, cars: &mut [LabelledCar], _frame: &FrameContext, draws: &Draws) {
        let mut random = draws.of_frame();
        for car in cars {
            let [along, across, up, turn]: [f64; 4] = std::array::from_fn(|_| StandardNormal.sample(&mut random));
            let slips = random.random_bool(self.slip_probability);
            let slip = if slips { self.slip_m * if random.random_bool(0.5) { 1.0 } else { -1.0 } } else { 0.0 };
            let shift = [self.longitudinal_std_m * along + slip, self.lateral_std_m * across, self.vertical_std_m * up];
            car.label.center = car.label.from_local(shift);
            car.label.yaw_rad += (self.yaw_std_deg * turn).to_radians();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn errors_have_the_configured_deviations() {
        let effect = LabelNoise {
            longitudinal_std_m: 0.3,
            lateral_std_m: 0.1,
            vertical_std_m: 0.05,
            yaw_std_deg: 1.0,
            slip_probability: 0.2,
            slip_m: 5.0,
        };
        let mut shifts: Vec<[f64; 4]> = Vec::new();
        for frame in 0..3000 {
            let mut cars = cars();
            with_frame(frame, |frame, draws| effect.on_labels(&mut cars, frame, draws));
            let [x, y, z] = cars[0].true_box.to_local(cars[0].label.center);
            shifts.push([x, y, z, (cars[0].label.yaw_rad - cars[0].true_box.yaw_rad).to_degrees()]);
        }
        let slipped = shifts.iter().filter(|s| s[0].abs() > 2.5).count() as f64 / shifts.len() as f64;
        assert!((slipped - 0.2).abs() < 0.03, "{slipped}");
        shifts.retain(|s| s[0].abs() < 2.5);
        for (k, want) in [0.3, 0.1, 0.05, 1.0].into_iter().enumerate() {
            let (mean, std) = moments(&shifts.iter().map(|s| s[k]).collect::<Vec<_>>());
            assert!(mean.abs() < 0.1 * want && (std / want - 1.0).abs() < 0.06, "{k}: {mean} {std}");
        }
    }
}
