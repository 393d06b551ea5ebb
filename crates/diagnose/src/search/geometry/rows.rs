//! Offsets of rows in range, or in elevation: which of the two.

use super::Hypothesis;
use crate::channels::groups::Grouping;
use crate::inference::choice::{Trial, total_and_z};

/// Tie-break between per-row range offsets and per-row elevation offsets: z is capped at this.
const Z_CAP: f64 = 30.0;

/// Tie-break: a hypothesis is rejected if its capped z is below this share of the other's.
const Z_SHARE: f64 = 0.75;

/// Tie-break: a hypothesis with at least this many times the gain of the other is kept whatever its z.
const GAIN_FACTOR: f64 = 2.0;

/// Rejects the less significant of per-row range offsets and per-row elevation offsets. The wrong one fits few rays
/// at grazing incidence, with large gains on few frames.
pub(super) fn drop_less_certain_rows(trials: &mut [Trial], candidates: &[&Hypothesis]) {
    let gain_and_z = |t: &Trial| {
        let (gain, z) = total_and_z(&t.gains);
        (gain, z.min(Z_CAP))
    };
    let of_rows = |t: &Trial| {
        t.above_floor && matches!(candidates[t.candidate], Hypothesis::Groups { grouping: Grouping::Row, .. })
    };
    let all: Vec<(f64, f64)> = trials.iter().filter(|t| of_rows(t)).map(gain_and_z).collect();
    let less_certain =
        |(gain, z): (f64, f64), (other, other_z): (f64, f64)| Z_SHARE * other_z > z && gain < GAIN_FACTOR * other;
    let dropped = |t: &Trial| all.iter().any(|&other| less_certain(gain_and_z(t), other));
    trials.iter_mut().filter(|t| of_rows(t)).for_each(|t| t.above_floor &= !dropped(t));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::catalogue::Cause;

    #[test]
    fn of_two_offsets_of_rows_the_more_significant_one_is_kept() {
        let rows = |cause, column| Hypothesis::Groups { cause, grouping: Grouping::Row, column };
        let hypotheses = [
            rows(Cause::BeamRangeOffset, 0),
            rows(Cause::BeamElevationOffset, 1),
            Hypothesis::Linear { cause: Cause::RangeBias, columns: vec![0] },
        ];
        let trial = |candidate: usize, gains: Vec<f64>| Trial {
            candidate,
            cause: hypotheses[candidate].cause(),
            parameters: 1,
            gains,
            expected: vec![],
            above_floor: true,
        };
        // A larger total gain from few frames, against a smaller one on every frame.
        let some: Vec<f64> = (0..20).map(|f| if f % 4 == 0 { 90.0 } else { 2.0 }).collect();
        let mut trials = vec![trial(0, vec![20.0; 20]), trial(1, some.clone()), trial(2, vec![1.0; 20])];
        drop_less_certain_rows(&mut trials, &hypotheses.iter().collect::<Vec<_>>());
        assert_eq!(trials.iter().map(|t| t.above_floor).collect::<Vec<_>>(), [true, false, true]);
        // Nearly as significant, or with far more gain: kept.
        for other in [(0..20).map(|f| 9.0 + 0.2 * f64::from(f % 2)).collect(), vec![2.0; 20]] {
            let mut trials = vec![trial(0, some.clone()), trial(1, other)];
            drop_less_certain_rows(&mut trials, &hypotheses.iter().collect::<Vec<_>>());
            assert!(trials[0].above_floor);
        }
    }
}
