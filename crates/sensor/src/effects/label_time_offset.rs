//! C5: a time offset between labels and cloud.

use super::{Draws, FrameContext, LabelledCar, Need, Reads, SensorEffect};
use data::KeyError;
use data::toml_text::within;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Labels show the cars as they were `offset_s` before the cloud. With `clock = "cars"` the clocks of the other cars
/// are wrong: the label is `v * offset_s` behind its car, v the velocity of the car over ground. With `clock = "cloud"`
/// the clock of the cloud is wrong, and ego motion counts as well: the label is `(v - v_ego - w x r) * offset_s` behind
/// its car, v_ego the ego velocity, w the ego turn rate, r the centre of the label, all in the cloud's frame.
///
/// Typical: 5 to 20 ms; 0.8 m at 70 m/s are 11 ms (Huch et al. 2023, section V).
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct LabelTimeOffset {
    /// Age of the labels relative to the cloud, s; negative for labels that are ahead.
    pub offset_s: f64,
    /// Which clock is wrong.
    pub clock: Clock,
}

/// Which clock is wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Clock {
    /// The clocks of the other cars.
    #[default]
    Cars,
    /// The clock of the cloud, relative to the positions of all cars, the ego vehicle included.
    Cloud,
}

impl SensorEffect for LabelTimeOffset {
    fn check(&self) -> Result<(), KeyError> {
        within("offset_s", self.offset_s, -1.0, 1.0)
    }

    fn needs(&self) -> Option<&'static [Need]> {
        Some(if self.clock == Clock::Cloud { &[Need::SeenMotion] } else { &[Need::Motion] })
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn on_labels(&self, cars: &mut [LabelledCar], frame: &FrameContext, _draws: &Draws) {
        let w = frame.ego_turn_rate;
        for car in cars {
            let r = car.label.center;
            let own = match self.clock {
                Clock::Cars => [0.0; 3],
                Clock::Cloud => {
                    let turn = [w[1] * r[2] - w[2] * r[1], w[2] * r[0] - w[0] * r[2], w[0] * r[1] - w[1] * r[0]];
                    std::array::from_fn(|k| frame.ego_velocity[k] + turn[k])
                }
            };
            for k in 0..3 {
                car.label.center[k] -= (car.velocity[k] - own[k]) * self.offset_s;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn labels_lag_by_the_motion() {
        let shift = |clock| {
            let mut cars = cars();
            with_frame(0, |frame, draws| LabelTimeOffset { offset_s: 0.01, clock }.on_labels(&mut cars, frame, draws));
            assert_eq!(cars[0].true_box, super::super::testing::cars()[0].true_box);
            let (label, car) = (cars[0].label.center, cars[0].true_box.center);
            [label[0] - car[0], label[1] - car[1]]
        };
        let (s, c) = 0.1_f64.sin_cos();
        let late = shift(Clock::Cars);
        assert!((late[0] + 0.6 * c).abs() < 1e-12 && (late[1] + 0.6 * s).abs() < 1e-12);
        let cloud = shift(Clock::Cloud);
        assert!(
            (cloud[0] - (late[0] + (50.0 - 0.2 * 2.0) * 0.01)).abs() < 1e-12
                && (cloud[1] - (late[1] + 0.2 * 20.0 * 0.01)).abs() < 1e-12
        );
    }
}
