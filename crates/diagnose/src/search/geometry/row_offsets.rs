//! The offset of each row of a sensor.
//!
//! Two things tell it. Beside other rows on one surface a row lies off the line that they make; and a row lies off the
//! simulated surface, as that of the whole sensor does where the surface is wrong. What nine neighbouring rows have in
//! common is known from the second alone. Each is measured in the quarters of the field of view, of which one may show
//! a wall that stands elsewhere.
//!
//! On the ground a row that measures too long looks like one that aims too low. Where rows do both, the range is known
//! by what stands, where elevations hardly matter, and the elevation by what is then left on the ground.

use super::hypotheses::{Hypothesis, is_pose};
use super::sums::{Sums, group_fit, precisions, row_columns};
use crate::catalogue::Cause;
use crate::channels::groups::{Group, GroupSums, PARTS, total};
use crate::channels::row_patches::{self, Band};
use crate::inference::grouped::{self, GroupFit};
use crate::inference::median;
use nalgebra::{Matrix2, Vector2};
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
    own: [f64; 2],
    level: [f64; 2],
}

/// Offsets of rows with their variances.
pub(super) type Rows = BTreeMap<Group, [f64; 2]>;

/// Offsets of the rows of a sensor in each of the chosen columns with their variances, shrunk as far as they are not
/// known.
pub(super) fn row_offsets(sums: &Sums, frames: &[usize], sensor: usize, chosen: &[Hypothesis]) -> [Rows; 2] {
    // Without another cause that turns what a sensor sees, its turn is what its rows have in common.
    let turns = |h: &Hypothesis| is_pose(h) || h.cause() == Cause::RollingShutter;
    let turned_by_rows = !chosen.iter().any(turns);
    let of = |column: usize, surfaces: Surfaces| {
        OfSensor::new(sums, frames, sensor, (column, surfaces), column == 1 && turned_by_rows)
    };
    let mut rows = [BTreeMap::new(), BTreeMap::new()];
    match row_columns(chosen)[..] {
        [] => {}
        [column] => rows[column] = alone(&of(column, Surfaces::All).measured(), column),
        _ => {
            let ground = of(1, Surfaces::Ground);
            rows = together(&of(0, Surfaces::Standing).measured(), &ground.measured(), &ground.ranges_as_elevations());
        }
    }
    rows.map(|rows| rows.into_iter().map(|(row, of)| (row_patches::group(sensor, row), of)).collect())
}

/// The surfaces that rows are measured on.
#[derive(Clone, Copy, PartialEq)]
enum Surfaces {
    All,
    Ground,
    Standing,
}

/// Robust standard deviation of some offsets.
fn spread(offsets: impl Iterator<Item = f64>) -> f64 {
    median(offsets.map(f64::abs).collect()) / statistics::MEDIAN_OF_NORMAL
}

/// What the means of neighbouring rows scatter by, where rows are independent.
fn of_mean(of_apart: f64) -> f64 {
    of_apart / (2.0 * BESIDE as f64 + 1.0).sqrt()
}

/// Offsets in one column, shrunk by what they scatter by. Errors of ranges are independent from row to row, elevations
/// may be wrong along a line.
fn alone(measured: &BTreeMap<usize, Measured>, column: usize) -> BTreeMap<usize, [f64; 2]> {
    let of_apart = spread(measured.values().map(|row| row.own[0]));
    let of_lines = || spread(measured.values().map(|row| row.level[0]));
    let of_common = if column == 0 { of_mean(of_apart) } else { of_lines().max(of_mean(of_apart)) };
    let shrunk = |of: [f64; 2], usual: f64| of.map(|v| v * usual.powi(2) / (usual.powi(2) + of[1]).max(1e-30));
    let offset = |(row, measured): (&usize, &Measured)| {
        let [own, level] = [shrunk(measured.own, of_apart), shrunk(measured.level, of_common)];
        (*row, [own[0] + level[0], own[1] + level[1]])
    };
    measured.iter().map(offset).collect()
}

/// Offsets of ranges and of elevations: `standing` are those of ranges by what stands, `ground` those of elevations by
/// the ground, as if ranges had none; `ratio` is by how much an elevation is wrong that has a range offset of 1 m.
fn together(
    standing: &BTreeMap<usize, Measured>,
    ground: &BTreeMap<usize, Measured>,
    ratio: &BTreeMap<usize, f64>,
) -> [BTreeMap<usize, [f64; 2]>; 2] {
    let range_m = spread(standing.values().map(|row| row.own[0]));
    let ratio = |row: &usize| ratio.get(row).copied().unwrap_or(0.0);
    let usual = |of: fn(&Measured) -> [f64; 2], range_m: f64| {
        // By the half of the rows of which the range matters least.
        let left = |(row, seen): (&usize, &Measured)| {
            let [range, of_range] = joint(standing.get(row).map(of), None, ratio(row), [range_m, 0.0])[0];
            (ratio(row).abs() * of_range.sqrt(), of(seen)[0] - ratio(row) * range)
        };
        let mut all: Vec<(f64, f64)> = ground.iter().map(left).collect();
        all.sort_by(|a, b| a.0.total_cmp(&b.0));
        all.truncate(all.len().div_ceil(2));
        spread(all.into_iter().map(|(_, left)| left))
    };
    let apart = [range_m, usual(|row| row.own, range_m)];
    let common = [of_mean(range_m), usual(|row| row.level, of_mean(range_m)).max(of_mean(apart[1]))];
    let mut out = [BTreeMap::new(), BTreeMap::new()];
    for row in standing.keys().chain(ground.keys()) {
        let [by_walls, by_ground] = [standing.get(row), ground.get(row)];
        let of = |of: fn(&Measured) -> [f64; 2], usual| joint(by_walls.map(of), by_ground.map(of), ratio(row), usual);
        let [own, level] = [of(|row| row.own, apart), of(|row| row.level, common)];
        let of_column = |column: usize| [own[column][0] + level[column][0], own[column][1] + level[column][1]];
        // A range that neither walls nor the ground tell is none that could scatter.
        if own[0][1] < 0.5 * apart[0].powi(2) {
            out[0].insert(*row, of_column(0));
        }
        by_ground.map(|_| out[1].insert(*row, of_column(1)));
    }
    out
}

/// Range and elevation of a row with their variances: by what stands, which tells the range, and by the ground, which
/// tells the elevation with `ratio` times the range; `usual` are what both scatter by.
fn joint(by_walls: Option<[f64; 2]>, by_ground: Option<[f64; 2]>, ratio: f64, usual: [f64; 2]) -> [[f64; 2]; 2] {
    let [a, b] = usual.map(|std| std.max(1e-9).powi(-2));
    let mut precision = Matrix2::new(a, 0.0, 0.0, b);
    let mut right = Vector2::zeros();
    let terms = [(by_walls, Vector2::new(1.0, 0.0)), (by_ground, Vector2::new(ratio, 1.0))];
    for ([offset, variance], levers) in terms.into_iter().filter_map(|(said, levers)| Some((said?, levers))) {
        let weight = 1.0 / variance.max(1e-18);
        precision += levers * levers.transpose() * weight;
        right += levers * (weight * offset);
    }
    let Some(covariance) = precision.try_inverse() else { return [[0.0; 2]; 2] };
    let offsets = covariance * right;
    [0, 1].map(|c| [offsets[c], covariance[(c, c)]])
}

/// Sums of the rows of a sensor over some frames, by quarter, for their offsets in one column.
struct OfSensor {
    column: usize,
    /// Beside other rows on one surface.
    beside: [Band; PARTS],
    /// Variance of what `beside` is made of, in units of the assumed one.
    of_patches: f64,
    /// Against the simulated surfaces.
    whole: [BTreeMap<Group, GroupSums>; PARTS],
    /// Whether what all rows have in common belongs to other causes.
    centred: bool,
}

impl OfSensor {
    fn new(
        sums: &Sums,
        frames: &[usize],
        sensor: usize,
        (column, surfaces): (usize, Surfaces),
        turned_by_rows: bool,
    ) -> OfSensor {
        let kinds = if turned_by_rows { &sums.rows_with_pose } else { &sums.parted_rows };
        let of_part = |part: usize| {
            let seen = [Surfaces::Ground, Surfaces::Standing].into_iter().zip(kinds);
            let seen = seen.filter(|(kind, _)| surfaces == Surfaces::All || surfaces == *kind);
            let mut all = total(seen.flat_map(|(_, of_kind)| frames.iter().map(move |&i| &of_kind[i][part])));
            all.retain(|g, _| usize::from(g.sensor) == sensor);
            all
        };
        let of_frames = || frames.iter().map(|&i| &sums.rows[i]);
        let beside = |part: usize| {
            let all = || row_patches::total(of_frames(), sensor, &|p| p == part);
            let standing = || row_patches::standing(of_frames(), sensor, &|p| p == part);
            match surfaces {
                Surfaces::All => all(),
                Surfaces::Ground => all().without(&standing()),
                Surfaces::Standing => standing(),
            }
        };
        OfSensor {
            column,
            beside: std::array::from_fn(beside),
            of_patches: sums.of_patches,
            whole: std::array::from_fn(of_part),
            centred: !turned_by_rows,
        }
    }

    /// By how much the elevation of each row seems wrong for each m of its range offset, rad/m.
    fn ranges_as_elevations(&self) -> BTreeMap<usize, f64> {
        let mut sums = BTreeMap::<usize, [f64; 2]>::new();
        for (row, sum) in self.whole.iter().flatten() {
            let of_row = sums.entry(usize::from(row.index)).or_default();
            (of_row[0], of_row[1]) = (of_row[0] + sum.gram[1], of_row[1] + sum.gram[2]);
        }
        sums.into_iter().map(|(row, [both, elevation])| (row, both / elevation.max(1e-12))).collect()
    }

    /// What each quarter says of the rows: beside other rows on one surface, and against the simulated ones.
    fn said(&self) -> [Quarters; 2] {
        let (column, how) = (self.column, GroupFit { centred: self.centred, ..group_fit(self.column) });
        let [mut beside, mut whole] = [Quarters::new(), Quarters::new()];
        for part in 0..PARTS {
            let of_part = &self.beside[part];
            let own = &of_part.offsets(precisions(&[column], self.of_patches))[column];
            for (row, offset) in own.iter().enumerate() {
                let precision = of_part.precision(row, column) / self.of_patches;
                if precision > 0.0 {
                    let said = Said::new(*offset, precision, of_part.squared_lever(row, column));
                    beside.entry(row).or_default()[part] = Some(said);
                }
            }
            let offsets = grouped::offsets(&self.whole[part], how);
            for (group, sum) in &self.whole[part] {
                let squares = sum.gram[2 * column];
                let said = Said::new(offsets[group], squares, squares / sum.weight.max(1e-12));
                whole.entry(usize::from(group.index)).or_default()[part] = Some(said);
            }
        }
        [beside, whole]
    }

    /// The rows that are known, without shrinking.
    fn measured(&self) -> BTreeMap<usize, Measured> {
        let [beside, whole] = self.said();
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
        let mut measured = BTreeMap::new();
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
            if said.len() > 1 && own[1] < 1.0 / (3.0 * group_fit(self.column).precision) {
                measured.insert(*row, Measured { own, level: combined(&level) });
            }
        }
        measured
    }
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

    /// Rows of a sensor 2 m above the ground, of which every other one meets a wall as well; the ground stands 1 mm
    /// elsewhere from row to row.
    #[test]
    fn what_walls_say_of_ranges_is_not_taken_for_elevations() {
        let mut rng = data::stream(7, "row offsets", 0, 0);
        let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
        for (range_m, elevation_rad) in [(0.01, 3e-4), (0.003, 2e-3)] {
            let (mut standing, mut ground, mut ratio) = (BTreeMap::new(), BTreeMap::new(), BTreeMap::new());
            let mut truth = Vec::new();
            for row in 0..64 {
                let below = 0.02 + 0.005 * row as f64;
                let (lever_m, range) = (2.0 / f64::tan(below), below.sin());
                let own = [range_m * normal(), elevation_rad * normal()];
                let none = [0.0, 1e-8];
                let measured = |offset: f64, error: f64| Measured { own: [offset, error * error], level: none };
                if row % 2 == 0 {
                    standing.insert(row, measured(own[0] + 0.001 * normal(), 0.001));
                }
                ratio.insert(row, range / lever_m);
                let error = 0.001 / lever_m;
                ground.insert(row, measured(own[1] + ratio[&row] * own[0] + error * normal(), error));
                truth.push(own);
            }
            let found = together(&standing, &ground, &ratio);
            for column in 0..2 {
                let beyond = |(row, [offset, variance]): (&usize, &[f64; 2])| {
                    ((offset - truth[*row][column]).powi(2) / variance, offset.powi(2) + variance)
                };
                let all: Vec<(f64, f64)> = found[column].iter().map(beyond).collect();
                let mean = |of: fn(&(f64, f64)) -> f64| all.iter().map(of).sum::<f64>() / all.len() as f64;
                let (squares, size) = (mean(|row| row.0), mean(|row| row.1).sqrt());
                assert!((32..=64).contains(&all.len()) && (0.5..1.6).contains(&squares), "{column}: {squares}");
                let usual = [range_m, elevation_rad][column];
                assert!((0.7..1.4).contains(&(size / usual)), "{column}: {size} for {usual}");
            }
        }
    }

    #[test]
    fn a_row_on_the_ground_alone_has_the_offsets_that_rows_usually_have() {
        // 1 mrad too low, or 20 cm too long: rows usually differ by 1 cm or by 1 mrad.
        let [[range_m, of_range], [elevation, _]] = joint(None, Some([1e-3, 1e-10]), 5e-3, [0.01, 1e-3]);
        assert!(range_m.abs() < 1e-3 && (of_range.sqrt() - 0.01).abs() < 1e-4 && (elevation - 1e-3).abs() < 1e-5);
        // Or by 20 cm or 0.1 mrad.
        let [[range_m, _], [elevation, _]] = joint(None, Some([1e-3, 1e-10]), 5e-3, [0.2, 1e-4]);
        assert!((range_m - 0.2).abs() < 0.01 && elevation.abs() < 2e-5, "{range_m} {elevation}");
        // The wall says how long it is.
        let [[range_m, _], [elevation, _]] = joint(Some([0.1, 1e-8]), Some([1e-3, 1e-10]), 5e-3, [0.2, 1e-3]);
        assert!((range_m - 0.1).abs() < 1e-3 && (elevation - 5e-4).abs() < 1e-5, "{range_m} {elevation}");
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
