//! Offsets of rows in range, or in elevation: which of the two.

use super::Suspect;
use crate::channels::groups::Grouping;
use crate::inference::choice::{Trial, total_and_z};

/// Of two offsets of rows: the z that is sure, the share of the surer one's z from which on the other one is as sure, and how many times as much it gains where
/// it needs not to be.
const SURE_OF_ROWS: f64 = 30.0;
const AS_SURE: f64 = 0.75;
const FAR_BETTER: f64 = 2.0;

/// Offsets of rows in range or in elevation that are less sure over frames than the other ones, and do not gain far more, are dropped: they fit few rays at
/// grazing angles, by much, on some frames.
pub(super) fn surer_rows(trials: &mut [Trial], candidates: &[&Suspect]) {
    let sure = |t: &Trial| {
        let (gain, z) = total_and_z(&t.gains);
        (gain, z.min(SURE_OF_ROWS))
    };
    let of_rows =
        |t: &Trial| t.above_floor && matches!(candidates[t.candidate], Suspect::Groups { grouping: Grouping::Row, .. });
    let all: Vec<(f64, f64)> = trials.iter().filter(|t| of_rows(t)).map(sure).collect();
    let surer =
        |(gain, z): (f64, f64), (other, other_z): (f64, f64)| AS_SURE * other_z > z && gain < FAR_BETTER * other;
    let dropped = |t: &Trial| all.iter().any(|&other| surer(sure(t), other));
    trials.iter_mut().filter(|t| of_rows(t)).for_each(|t| t.above_floor &= !dropped(t));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_two_offsets_of_rows_the_surer_one_is_kept() {
        let rows = |name, column| Suspect::Groups { name, grouping: Grouping::Row, column };
        let suspects = [
            rows("beam_range_offset", 0),
            rows("beam_elevation_offset", 1),
            Suspect::Linear { name: "range_bias", columns: vec![0] },
        ];
        let trial = |candidate: usize, gains: Vec<f64>| Trial {
            candidate,
            name: suspects[candidate].name().into(),
            parameters: 1,
            gains,
            above_floor: true,
        };
        // More on the whole, by some frames, and a little less on every frame.
        let some: Vec<f64> = (0..20).map(|f| if f % 4 == 0 { 90.0 } else { 2.0 }).collect();
        let mut trials = vec![trial(0, vec![20.0; 20]), trial(1, some.clone()), trial(2, vec![1.0; 20])];
        surer_rows(&mut trials, &suspects.iter().collect::<Vec<_>>());
        assert_eq!(trials.iter().map(|t| t.above_floor).collect::<Vec<_>>(), [true, false, true]);
        // As sure, next to, or far better: the gain decides.
        for other in [(0..20).map(|f| 9.0 + 0.2 * f64::from(f % 2)).collect(), vec![2.0; 20]] {
            let mut trials = vec![trial(0, some.clone()), trial(1, other)];
            surer_rows(&mut trials, &suspects.iter().collect::<Vec<_>>());
            assert!(trials[0].above_floor);
        }
    }
}
