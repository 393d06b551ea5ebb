//! B3: returns lost by a lookup table over range.

use super::random_dropout::drop_some;
use super::table::{check_table, interpolated};
use super::{Draws, FrameContext, Reads, SensorEffect};
use crate::scan::Scan;
use data::KeyError;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A return at range R is lost with the probability of the table (`range_m`, `share`) at R. The table is interpolated
/// linearly and constant beyond both ends. An empty table loses nothing.
///
/// Typical: 0 at short range to 0.3 at 100 m. The "distribution-matched" downsampling of Huch et al. 2023 is a table
/// fitted to a pair of data sets: [`crate::matched::fit_range_dropout`].
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RangeDropout {
    /// Ranges, strictly ascending, m.
    pub range_m: Vec<f64>,
    /// Probability of a loss at each range, 0 to 1.
    pub share: Vec<f64>,
}

impl RangeDropout {
    /// Probability of a loss at a range.
    pub fn share_at(&self, range_m: f64) -> f64 {
        if self.range_m.is_empty() { 0.0 } else { interpolated(&self.range_m, &self.share, range_m) }
    }
}

impl SensorEffect for RangeDropout {
    fn check(&self) -> Result<(), KeyError> {
        if self.range_m.is_empty() && self.share.is_empty() {
            return Ok(());
        }
        check_table(("range_m", &self.range_m, [0.0, 1e4]), ("share", &self.share, [0.0, 1.0]))
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn on_scan(&self, scan: &mut Scan, _frame: &FrameContext, draws: &Draws) {
        drop_some(scan, draws, |echo| self.share_at(echo.range_m.into()) as f32);
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn losses_follow_the_table() {
        let effect = RangeDropout { range_m: vec![10.0, 50.0, 100.0], share: vec![0.1, 0.5, 0.3] };
        for (range_m, want) in [(5.0, 0.1), (30.0, 0.3), (75.0, 0.4), (200.0, 0.3)] {
            let before = plate(20_000, range_m, 0.5);
            let got = lost(&before, &applied(&effect, &before));
            assert!((got - want).abs() < 0.012, "{range_m}: {got} {want}");
        }
    }

    #[test]
    fn bad_tables_are_refused() {
        let table = |range_m: &[f64], share: &[f64]| RangeDropout { range_m: range_m.into(), share: share.into() };
        for (effect, want) in [
            (table(&[1.0], &[]), "as many of each"),
            (table(&[], &[0.1]), "as many of each"),
            (table(&[1.0, 2.0], &[0.1]), "as many of each"),
            (table(&[1.0, 1.0], &[0.1, 0.2]), "range_m[1]: is not larger"),
            (table(&[1.0, 2.0], &[0.1, 1.2]), "share[1]: 1.2"),
        ] {
            assert!(effect.check().unwrap_err().to_string().contains(want));
        }
    }
}
