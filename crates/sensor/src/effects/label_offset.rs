//! C6: a constant label error in the object's frame.

use super::{Draws, FrameContext, LabelledCar, Reads, SensorEffect};
use data::KeyError;
use data::toml_text::within;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Every label is shifted by `forward_m`, `left_m`, `up_m` in its own frame and rotated by `yaw_deg`. Cause: a wrong
/// lever arm from the GNSS antenna to the centre of the car.
///
/// Typical: 0.1 to 1 m.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct LabelOffset {
    /// Shift along the heading, m.
    pub forward_m: f64,
    /// Shift to the left, m.
    pub left_m: f64,
    /// Shift upwards, m.
    pub up_m: f64,
    /// Rotation, degrees counter-clockwise.
    pub yaw_deg: f64,
}

impl SensorEffect for LabelOffset {
    fn check(&self) -> Result<(), KeyError> {
        for (key, value) in [("forward_m", self.forward_m), ("left_m", self.left_m), ("up_m", self.up_m)] {
            within(key, value, -20.0, 20.0)?;
        }
        within("yaw_deg", self.yaw_deg, -180.0, 180.0)
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn on_labels(&self, cars: &mut [LabelledCar], _frame: &FrameContext, _draws: &Draws) {
        for car in cars {
            car.label.center = car.label.from_local([self.forward_m, self.left_m, self.up_m]);
            car.label.yaw_rad += self.yaw_deg.to_radians();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn the_shift_is_in_the_car_s_frame() {
        let effect = LabelOffset { forward_m: 0.4, left_m: -0.2, up_m: 0.1, yaw_deg: 2.0 };
        let mut cars = cars();
        with_frame(0, |frame, draws| effect.on_labels(&mut cars, frame, draws));
        let local = cars[0].true_box.to_local(cars[0].label.center);
        assert!((local[0] - 0.4).abs() < 1e-9 && (local[1] + 0.2).abs() < 1e-9 && (local[2] - 0.1).abs() < 1e-9);
        assert!((cars[0].label.yaw_rad - cars[0].true_box.yaw_rad - 2_f64.to_radians()).abs() < 1e-12);
    }
}
