//! Whether offsets of rows stay the same over a recording. A row that measures wrongly does so from the first frame to
//! the last; what comes with time has another cause.

use super::Search;
use super::floor::FLOOR_GROUPS;
use super::hypotheses::Hypothesis;
use super::row_offsets::Rows;
use crate::channels::groups::Group;
use crate::inference::grouped::spread_of_rows;

/// Course of the changes that are looked for: the middle one of `Moment::course`.
const COURSE: usize = 1;

/// Change of the offsets over the recording, as a share of their mean over it, from which on they are not steady.
const LEAST_SHARE: f64 = 0.5;

/// Whether the offsets of rows in range (column 0) or in elevation (column 1) come with time: they change over the
/// recording, by more than a small part of their mean, and those at its beginning are not seen. Not known without
/// times.
pub(super) fn come_with_time(search: &Search, column: usize, chosen: &[Hypothesis]) -> bool {
    if !search.sums.moments.passes {
        return false;
    }
    let mut frames = [&search.select[..], &search.estimate[..]].concat();
    frames.sort_unstable();
    let (early, late) = frames.split_at(frames.len() / 2);
    let moments = &search.sums.moments.of_frames;
    let at = |half: &[usize]| half.iter().map(|&f| moments[f].course(COURSE)).sum::<f64>() / half.len().max(1) as f64;
    let rows = |half: &[usize]| std::mem::take(&mut search.sums.rows(half, chosen)[column]);
    let [beginning, change, mean] = parts([&rows(early), &rows(late)], [at(early), at(late)]);
    let [beginning, change, mean] = [beginning, change, mean].map(|rows| spread_of_rows(&rows).0);
    let least = FLOOR_GROUPS[column];
    change > least.max(LEAST_SHARE * mean) && beginning < least.max(0.5 * change)
}

/// Of the offsets in two halves of a recording, in which a change has come by the shares `at`: those at its beginning,
/// what they change by over all of it, and their mean over the halves.
fn parts([early, late]: [&Rows; 2], at: [f64; 2]) -> [Rows; 3] {
    let apart = (at[1] - at[0]).max(1e-9);
    let combined = |by: [f64; 2]| -> Rows {
        let of = |(group, a): (&Group, &[f64; 2])| {
            let b = late.get(group)?;
            Some((*group, [by[0] * a[0] + by[1] * b[0], by[0] * by[0] * a[1] + by[1] * by[1] * b[1]]))
        };
        early.iter().filter_map(of).collect()
    };
    [combined([at[1] / apart, -at[0] / apart]), combined([-1.0 / apart, 1.0 / apart]), combined([0.5, 0.5])]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_comes_with_time_is_not_there_at_the_beginning() {
        let rows = |by: f64| -> Rows {
            let row = |index: u16| {
                let sign = if index.is_multiple_of(2) { 1.0 } else { -1.0 };
                (Group { sensor: 0, index }, [sign * by, 1e-6])
            };
            (0..16).map(row).collect()
        };
        let spreads =
            |early: f64, late: f64| parts([&rows(early), &rows(late)], [0.4, 0.9]).map(|rows| spread_of_rows(&rows).0);
        // 5 cm at the end, and a steady 5 cm.
        let [beginning, change, _] = spreads(0.02, 0.045);
        assert!(beginning < 0.003 && (change - 0.05).abs() < 0.003, "{beginning} {change}");
        let [beginning, change, mean] = spreads(0.05, 0.05);
        assert!(change < 0.003 && (beginning - 0.05).abs() < 0.003 && (mean - 0.05).abs() < 0.001);
    }
}
