//! E3: random order of the points.

use super::{Draws, FrameContext, Reads, SensorEffect};
use crate::scan::Scan;
use data::KeyError;
use rand::seq::SliceRandom;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// If `shuffled` is true, the points of a cloud are in random order, as after merging the clouds of several sensors
/// over a network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PointOrder {
    /// Put the points in random order.
    pub shuffled: bool,
}

impl SensorEffect for PointOrder {
    fn check(&self) -> Result<(), KeyError> {
        Ok(())
    }

    fn reads(&self) -> Reads {
        if self.shuffled { Reads::EMPTY_SHOTS } else { Reads::NOTHING }
    }

    fn on_scan(&self, scan: &mut Scan, _frame: &FrameContext, draws: &Draws) {
        if self.shuffled {
            scan.echoes.shuffle(&mut draws.of_frame());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn the_same_points_in_another_order() {
        let before = scene();
        let after = applied(&PointOrder { shuffled: true }, &before);
        assert_ne!(before, after);
        assert_eq!(applied(&PointOrder { shuffled: false }, &before), before);
        let sorted = |scan: &Scan| {
            let mut keys: Vec<_> = scan.echoes.iter().map(|e| (e.row, e.column, e.range_m.to_bits())).collect();
            keys.sort_unstable();
            keys
        };
        assert_eq!(sorted(&before), sorted(&after));
    }
}
