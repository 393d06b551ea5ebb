//! E3: random order of the points.

use super::{Draws, FrameContext, SensorEffect};
use crate::scan::Scan;
use data::KeyError;
use rand::seq::SliceRandom;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The points of a cloud are in random order, as after merging the clouds of several sensors over a network.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct PointOrder {}

impl SensorEffect for PointOrder {
    fn check(&self) -> Result<(), KeyError> {
        Ok(())
    }

    fn on_scan(&self, scan: &mut Scan, _frame: &FrameContext, draws: &Draws) {
        scan.echoes.shuffle(&mut draws.of_frame());
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn the_same_points_in_another_order() {
        let before = scene();
        let after = applied(&PointOrder {}, &before);
        assert_ne!(before, after);
        let sorted = |scan: &Scan| {
            let mut keys: Vec<_> = scan.echoes.iter().map(|e| (e.row, e.column, e.range_m.to_bits())).collect();
            keys.sort_unstable();
            keys
        };
        assert_eq!(sorted(&before), sorted(&after));
    }
}
