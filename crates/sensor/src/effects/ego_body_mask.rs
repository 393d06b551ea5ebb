//! B7: directions hidden by parts of the ego vehicle.

use super::{Draws, FrameContext, SensorEffect};
use crate::scan::{Echo, Scan};
use data::KeyError;
use data::toml_text::{within, wrong};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A shot that intersects one of `boxes` before its measured range has no return.
///
/// Typical: the rear wing of the AV-21, which hides a trapezoid of about 10 x 5 m behind the car (Huch et al. 2023,
/// section IV-A). Its boxes are in `configs/simulate/measured.toml`.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct EgoBodyMask {
    /// Axis-aligned boxes in the cloud's frame, m: minimum x, y, z, then maximum x, y, z.
    pub boxes: Vec<[f64; 6]>,
}

impl SensorEffect for EgoBodyMask {
    fn check(&self) -> Result<(), KeyError> {
        for (i, b) in self.boxes.iter().enumerate() {
            for (k, v) in b.iter().enumerate() {
                within(&format!("boxes[{i}][{k}]"), *v, -100.0, 100.0)?;
            }
            if (0..3).any(|k| b[k] >= b[k + 3]) {
                return Err(wrong(format!("boxes[{i}]"), "a minimum is not less than its maximum"));
            }
        }
        Ok(())
    }

    fn on_scan(&self, scan: &mut Scan, _frame: &FrameContext, _draws: &Draws) {
        let boxes: Vec<[f32; 6]> = self.boxes.iter().map(|b| b.map(|v| v as f32)).collect();
        for echo in scan.returns_mut() {
            if boxes.iter().any(|b| passes(echo, b)) {
                echo.lose();
            }
        }
    }
}

/// Whether a shot intersects a box before its return.
fn passes(echo: &Echo, b: &[f32; 6]) -> bool {
    let (mut near, mut far) = (0.0, echo.range_m);
    for k in 0..3 {
        if echo.direction[k] == 0.0 {
            if !(b[k]..=b[k + 3]).contains(&echo.origin[k]) {
                return false;
            }
            continue;
        }
        let (a, z) = ((b[k] - echo.origin[k]) / echo.direction[k], (b[k + 3] - echo.origin[k]) / echo.direction[k]);
        near = f32::max(near, a.min(z));
        far = f32::min(far, a.max(z));
    }
    near < far
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn returns_behind_the_box_are_lost_in_every_frame() {
        let before = scene();
        // A board 2 m ahead, 0.4 m wide, around the sensor's horizon.
        let effect = EgoBodyMask { boxes: vec![[2.0, -0.2, -0.1, 2.1, 0.2, 0.1]] };
        let after = applied_in(9, &effect, &before);
        assert_eq!(after, applied(&effect, &before));
        for (a, b) in before.echoes.iter().zip(&after.echoes).filter(|(a, _)| a.is_return()) {
            let [x, y, z] = a.direction;
            let (across, up) = ((2.0 * y / x).abs(), (2.0 * z / x).abs());
            if across < 0.18 && up < 0.09 {
                assert!(!b.is_return());
            }
            if across > 0.25 || up > 0.13 {
                assert!(b.is_return());
            }
        }
        assert!(lost(&before, &after) > 0.002);
    }

    #[test]
    fn returns_before_the_box_stay() {
        let before = plate(10, 1.5, 0.5);
        let effect = EgoBodyMask { boxes: vec![[2.0, -0.2, -0.1, 2.1, 0.2, 0.1]] };
        assert_eq!(lost(&before, &applied(&effect, &before)), 0.0);
        assert!(EgoBodyMask { boxes: vec![[1.0, 0.0, 0.0, 0.5, 1.0, 1.0]] }.check().is_err());
    }
}
