//! C8: errors of the other cars' roll and pitch.

use super::{Need, SensorEffect, WorldPlan};
use data::KeyError;
use data::toml_text::within;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The true attitude of every other car differs from the modelled one by roll `roll_deg + roll_std_deg * N(0, 1)` and
/// pitch `pitch_deg + pitch_std_deg * N(0, 1)`, about the centre of its rear axle. Positive pitch turns the nose down.
/// Values are drawn anew in every frame.
///
/// Typical: standard deviations of 0.1 to 0.3 degrees. Labels have neither roll nor pitch (Huch et al. 2023, section
/// V).
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct TargetAttitude {
    /// Mean roll, degrees; positive turns the left side up.
    pub roll_deg: f64,
    /// Mean pitch, degrees; positive turns the nose down.
    pub pitch_deg: f64,
    /// Standard deviation of roll between frames, degrees.
    pub roll_std_deg: f64,
    /// Standard deviation of pitch between frames, degrees.
    pub pitch_std_deg: f64,
}

impl SensorEffect for TargetAttitude {
    fn check(&self) -> Result<(), KeyError> {
        within("roll_deg", self.roll_deg, -20.0, 20.0)?;
        within("pitch_deg", self.pitch_deg, -20.0, 20.0)?;
        within("roll_std_deg", self.roll_std_deg, 0.0, 10.0)?;
        within("pitch_std_deg", self.pitch_std_deg, 0.0, 10.0)
    }

    fn needs(&self) -> Option<&'static [Need]> {
        None
    }

    fn on_world(&self, world: &mut WorldPlan) {
        let own = [[self.roll_deg, self.roll_std_deg], [self.pitch_deg, self.pitch_std_deg]];
        for (sum, own) in world.car_tilt.iter_mut().zip(own) {
            let [mean, std] = own.map(f64::to_radians);
            *sum = [sum[0] + mean, sum[1].hypot(std)];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tilts_of_two_effects_add_up() {
        let effect = TargetAttitude { roll_deg: 1.0, pitch_deg: -2.0, roll_std_deg: 0.3, pitch_std_deg: 0.0 };
        let mut world = WorldPlan::default();
        effect.on_world(&mut world);
        effect.on_world(&mut world);
        let degrees = world.car_tilt.map(|t| t.map(f64::to_degrees));
        let want = [[2.0, 0.3 * 2_f64.sqrt()], [-4.0, 0.0]];
        for (got, want) in degrees.iter().flatten().zip(want.iter().flatten()) {
            assert!((got - want).abs() < 1e-9, "{degrees:?}");
        }
    }
}
