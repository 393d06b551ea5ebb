//! The offset of each row of a sensor.
//!
//! Two things tell it. Beside other rows on one surface a row lies off the line that they make; and a row lies off the
//! simulated surface, as that of the whole sensor does where the surface is wrong. What nine neighbouring rows have in
//! common is known from the second alone. Each is measured in the quarters of the field of view, of which one may show
//! a wall that stands elsewhere.

use super::hypotheses::{Hypothesis, is_pose};
use super::sums::{Sums, group_fit, precisions, row_columns};
use crate::catalogue::Cause;
use crate::channels::groups::{Group, PARTS, total};
use crate::channels::row_patches;
use crate::inference::grouped::{self, GroupFit};
use crate::inference::median;
use std::collections::BTreeMap;

/// Rows to either side of one that have something in common.
const BESIDE: usize = 4;

/// What one quarter of the field of view says of the offset of a row.
#[derive(Clone, Copy, Debug)]
struct Said {
    offset: f64,
    /// Variance by chance.
    chance: f64,
    /// Variance for each m2 of the variance of a surface's error: one over the squared lever.
    by_surface: f64,
}

impl Said {
    fn new(offset: f64, precision: f64, squared_lever: f64) -> Said {
        Said { offset, chance: 1.0 / precision.max(1e-12), by_surface: 1.0 / squared_lever.max(1e-12) }
    }

    /// Weight where surfaces have errors of some variance, m2.
    fn weight(&self, surface_m2: f64) -> f64 {
        1.0 / (self.chance + surface_m2 * self.by_surface)
    }
}

/// By row, what each quarter says.
type Quarters = BTreeMap<usize, [Option<Said>; PARTS]>;

/// All that is said: row, quarter and what.
fn each(rows: &Quarters) -> impl Iterator<Item = (usize, usize, Said)> {
    let of_row = |(row, quarters): (&usize, &[Option<Said>; PARTS])| {
        let (row, quarters) = (*row, *quarters);
        (0..PARTS).filter_map(move |part| Some((row, part, quarters[part]?)))
    };
    rows.iter().flat_map(of_row)
}

/// Variance of an offset of which nothing is said, m2 or rad2: without bound, but where nothing is said of any of some
/// rows their weights are still equal.
const UNKNOWN: f64 = 1e6;

/// Variance of the errors of the surfaces, m2: what quarters differ by beyond chance, over their levers; the median of
/// the rows.
fn surface_m2(rows: &Quarters) -> f64 {
    let of_row = |quarters: &[Option<Said>; PARTS]| {
        let said: Vec<Said> = quarters.iter().flatten().copied().collect();
        let n = said.len() as f64;
        let sum = |of: &dyn Fn(&Said) -> f64| said.iter().map(of).sum::<f64>();
        // By the weights that the levers alone give.
        let middle = sum(&|s| s.offset / s.by_surface) / sum(&|s| 1.0 / s.by_surface);
        let squares = sum(&|s| ((s.offset - middle).powi(2) - s.chance) / s.by_surface);
        (said.len() > 1).then(|| (squares / (n - 1.0)).max(0.0))
    };
    median(rows.values().filter_map(of_row).collect())
}

/// Weighted median of some numbers with their weights, and its variance: that by the weights, or by the scatter where
/// that is more.
fn combined(said: &[[f64; 2]]) -> [f64; 2] {
    let weights: f64 = said.iter().map(|s| s[1]).sum();
    let mut sorted = said.to_vec();
    sorted.sort_by(|a, b| a[0].total_cmp(&b[0]));
    let middle = weighted_median(&sorted, weights);
    let squares: f64 = said.iter().map(|s| s[1] * (s[0] - middle).powi(2)).sum();
    let beyond = (squares / (said.len() as f64 - 1.0).max(1.0)).max(1.0);
    [middle, beyond / weights.max(1e-12)]
}

/// Between the middles of the weights of sorted numbers.
fn weighted_median(sorted: &[[f64; 2]], weights: f64) -> f64 {
    let mut before: Option<[f64; 2]> = None;
    let mut sum = 0.0;
    for [value, weight] in sorted {
        let at = sum + 0.5 * weight;
        if at >= 0.5 * weights {
            return before.map_or(*value, |[low, from]| low + (value - low) * (0.5 * weights - from) / (at - from));
        }
        (before, sum) = (Some([*value, at]), sum + weight);
    }
    sorted.last().map_or(0.0, |s| s[0])
}

/// A row over all quarters: its deviation from the rows around and what these have in common, with variances.
struct Measured {
    row: usize,
    own: [f64; 2],
    level: [f64; 2],
}

/// Offsets of the rows of a sensor in one column with their variances, shrunk as far as they are not known.
pub(super) fn row_offsets(
    sums: &Sums,
    frames: &[usize],
    sensor: usize,
    column: usize,
    chosen: &[Hypothesis],
) -> BTreeMap<Group, [f64; 2]> {
    let [beside, whole] = said(sums, frames, sensor, column, chosen);
    let of_whole = surface_m2(&whole);
    // The deviation from the rows around by both, and what the rows around have in common.
    let [mut by_rows, mut by_surfaces, mut common] = [Quarters::new(), Quarters::new(), Quarters::new()];
    let own = |row: usize, part: usize| beside.get(&row).and_then(|quarters| quarters[part]);
    for (row, part, seen) in each(&whole) {
        // Of the rows around: weights, offsets beside others and against the simulation, variances.
        let mut mean = [0.0; 4];
        for (r, quarters) in whole.range(row.saturating_sub(BESIDE)..=row + BESIDE) {
            let Some(seen) = quarters[part] else { continue };
            let (offset, chance) = own(*r, part).map_or((0.0, UNKNOWN), |own| (own.offset, own.chance));
            let variance = 1.0 / seen.weight(of_whole);
            let w = 1.0 / (variance + chance);
            mean.iter_mut().zip([1.0, offset, seen.offset, variance]).for_each(|(sum, term)| *sum += w * term);
        }
        let [w, of_own, of_seen, variance] = mean;
        let set = |to: &mut Quarters, said| to.entry(row).or_default()[part] = Some(said);
        if let Some(own) = own(row, part) {
            set(&mut by_rows, Said { offset: own.offset - of_own / w, ..own });
        }
        set(&mut by_surfaces, Said { offset: seen.offset - of_seen / w, ..seen });
        // Errors of a surface are those of all rows that meet it: more rows do not make them smaller.
        set(&mut common, Said { offset: of_seen / w, chance: variance / w, by_surface: 0.0 });
    }
    let of_rows = surface_m2(&by_rows);
    let mut measured: Vec<Measured> = Vec::new();
    for (row, quarters) in &by_surfaces {
        let both = |part: usize| {
            let seen = quarters[part]?;
            let (offset, v) =
                by_rows.get(row).and_then(|q| q[part]).map_or((0.0, 0.0), |a| (a.offset, a.weight(of_rows)));
            let w = seen.weight(of_whole);
            Some([(v * offset + w * seen.offset) / (v + w), v + w])
        };
        let said: Vec<[f64; 2]> = (0..PARTS).filter_map(both).collect();
        let level: Vec<[f64; 2]> = common[row].iter().flatten().map(|s| [s.offset, s.weight(0.0)]).collect();
        let own = combined(&said);
        if said.len() > 1 && own[1] < 1.0 / (3.0 * group_fit(column).precision) {
            measured.push(Measured { row: *row, own, level: combined(&level) });
        }
    }
    let spread = |of: fn(&Measured) -> f64| {
        median(measured.iter().map(|row| of(row).abs()).collect()) / statistics::MEDIAN_OF_NORMAL
    };
    let of_apart = spread(|row| row.own[0]);
    // Errors of ranges are independent from row to row: this is what their mean over neighbours scatters by.
    // Elevations may be wrong along a line.
    let of_mean = of_apart / (2.0 * BESIDE as f64 + 1.0).sqrt();
    let of_common = if column == 0 { of_mean } else { spread(|row| row.level[0]).max(of_mean) };
    let shrunk = |of: [f64; 2], usual: f64| of.map(|v| v * usual.powi(2) / (usual.powi(2) + of[1]).max(1e-30));
    let offset = |row: &Measured| {
        let [own, level] = [shrunk(row.own, of_apart), shrunk(row.level, of_common)];
        (row_patches::group(sensor, row.row), [own[0] + level[0], own[1] + level[1]])
    };
    measured.iter().map(offset).collect()
}

/// What each quarter says of the rows of a sensor: beside other rows on one surface, and against the simulated ones.
fn said(sums: &Sums, frames: &[usize], sensor: usize, column: usize, chosen: &[Hypothesis]) -> [Quarters; 2] {
    let columns = row_columns(chosen);
    // Without another cause that turns what a sensor sees, its turn is what its rows have in common.
    let turns = |h: &Hypothesis| is_pose(h) || h.cause() == Cause::RollingShutter;
    let turned_by_rows = column == 1 && !chosen.iter().any(turns);
    let of_whole = if turned_by_rows { &sums.rows_with_pose } else { &sums.whole_rows.parted };
    let how = GroupFit { centred: !turned_by_rows, ..group_fit(column) };
    let [mut beside, mut whole] = [Quarters::new(), Quarters::new()];
    for part in 0..PARTS {
        let of_part = row_patches::total(frames.iter().map(|&i| &sums.rows[i]), sensor, &|p| p == part);
        let own = &of_part.offsets(precisions(&columns, sums.of_patches))[column];
        for (row, offset) in own.iter().enumerate() {
            let precision = of_part.precision(row, column) / sums.of_patches;
            if precision > 0.0 {
                let said = Said::new(*offset, precision, of_part.squared_lever(row, column));
                beside.entry(row).or_default()[part] = Some(said);
            }
        }
        let mut all = total(frames.iter().map(|&i| &of_whole[i][part]));
        all.retain(|g, _| usize::from(g.sensor) == sensor);
        let offsets = grouped::offsets(&all, how);
        for (group, sum) in all {
            let squares = sum.gram[2 * column];
            let said = Said::new(offsets[&group], squares, squares / sum.weight.max(1e-12));
            whole.entry(usize::from(group.index)).or_default()[part] = Some(said);
        }
    }
    [beside, whole]
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand_distr::{Distribution, StandardNormal};

    #[test]
    fn the_weighted_median_is_between_the_middles_of_the_weights() {
        let median = |values: &[[f64; 2]]| combined(values)[0];
        assert_eq!(median(&[[3.0, 1.0], [1.0, 1.0], [2.0, 1.0]]), 2.0);
        assert_eq!(median(&[[1.0, 1.0], [2.0, 1.0]]), 1.5);
        // A quarter that knows much more than the others decides.
        assert_eq!(median(&[[1.0, 1.0], [5.0, 100.0], [9.0, 1.0]]), 5.0);
        assert_eq!(median(&[[4.0, 0.1]]), 4.0);
        // The variance is that by the weights, or by the scatter.
        assert_eq!(combined(&[[1.0, 2.0], [1.0, 2.0]])[1], 0.25);
        assert!(combined(&[[-1.0, 2.0], [1.0, 2.0]])[1] > 0.9);
    }

    #[test]
    fn errors_of_surfaces_are_found_by_their_levers() {
        let mut rng = data::stream(6, "row offsets", 0, 0);
        let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
        // Ground 10 m away and walls that a turn moves by 1 m a radian, both off by 3 mm.
        let mut row = |row: usize| {
            let quarter = |part: usize| {
                let lever = if part < 2 { 10.0 } else { 1.0 };
                Some(Said::new(0.001 + 0.003 * normal() / lever, 1e10, lever * lever))
            };
            (row, [0, 1, 2, 3].map(quarter))
        };
        let rows: Quarters = (0..400).map(&mut row).collect();
        let found_m = surface_m2(&rows).sqrt();
        assert!((0.002..0.004).contains(&found_m), "{found_m}");
        // The ground decides where the offset is.
        let said = |quarters: &[Option<Said>; PARTS]| -> Vec<[f64; 2]> {
            quarters.iter().flatten().map(|s| [s.offset, s.weight(found_m * found_m)]).collect()
        };
        let off = rows.values().map(|q| (combined(&said(q))[0] - 0.001).powi(2)).sum::<f64>() / rows.len() as f64;
        assert!(off.sqrt() < 1.2 * 0.0003, "{}", off.sqrt());
    }
}
