//! C11: differences between the other cars and their model.

use super::{Need, SensorEffect, WorldPlan};
use data::KeyError;
use data::toml_text::within;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The true bodies of the other cars are those of the model, scaled by `scale` about the centre of the bottom of their
/// box and shifted by `shift_m`. Labels keep the box of the model.
///
/// Typical: centimetres to a decimetre: scale [0.98, 1.0, 0.96].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct TargetShape {
    /// Scale of length, width, height.
    pub scale: [f64; 3],
    /// Shift forward, left, up in the car's frame, m.
    pub shift_m: [f64; 3],
}

impl Default for TargetShape {
    fn default() -> Self {
        TargetShape { scale: [1.0; 3], shift_m: [0.0; 3] }
    }
}

impl SensorEffect for TargetShape {
    fn check(&self) -> Result<(), KeyError> {
        for k in 0..3 {
            within(&format!("scale[{k}]"), self.scale[k], 0.2, 5.0)?;
            within(&format!("shift_m[{k}]"), self.shift_m[k], -5.0, 5.0)?;
        }
        Ok(())
    }

    fn needs(&self) -> Option<&'static [Need]> {
        None
    }

    fn on_world(&self, world: &mut WorldPlan) {
        for k in 0..3 {
            world.car_scale[k] *= self.scale[k];
            world.car_shift_m[k] += self.shift_m[k];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scales_multiply_and_shifts_add() {
        let mut world = WorldPlan::default();
        let effect = TargetShape { scale: [0.5, 1.0, 2.0], shift_m: [0.1, 0.0, -0.2] };
        effect.on_world(&mut world);
        effect.on_world(&mut world);
        assert_eq!(world.car_scale, [0.25, 1.0, 4.0]);
        assert_eq!(world.car_shift_m, [0.2, 0.0, -0.4]);
    }
}
