//! Offsets of groups of rays, shrunk by a prior, and their cross-validated gains.

use super::linear::{FOLDS, fold_of};
use super::median;
use crate::channels::groups::{Group, GroupFrame, GroupSums, PARTS, PartedFrame, total};
use std::collections::BTreeMap;

/// How offsets of groups are fitted.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GroupFit {
    /// Which of the two columns of the sums.
    pub column: usize,
    /// Prior precision of an offset.
    pub precision: f64,
    /// Whether the mean of all groups is subtracted: it belongs to other causes.
    pub centred: bool,
    /// Factor on the offset that other parts of a group predict for a part: below 1 where parts agree in sign rather
    /// than in size.
    pub trust: f64,
}

/// Offset of each group.
pub fn offsets(sums: &BTreeMap<Group, GroupSums>, how: GroupFit) -> BTreeMap<Group, f64> {
    let mut out: BTreeMap<Group, f64> = sums.iter().map(|(k, s)| (*k, s.offset(how.column, how.precision))).collect();
    if how.centred {
        let (mut sum, mut weight) = (0.0, 0.0);
        for (k, s) in sums {
            let w = s.gram[2 * how.column].min(1e4 * how.precision);
            sum += w * out[k];
            weight += w;
        }
        let mean = if weight > 0.0 { sum / weight } else { 0.0 };
        out.values_mut().for_each(|v| *v -= mean);
    }
    out
}

/// Gain of a frame by offsets, nats.
pub fn gain(frame: &GroupFrame, column: usize, offsets: &BTreeMap<Group, f64>) -> f64 {
    frame.iter().filter_map(|(k, s)| Some(s.gain(column, *offsets.get(k)?))).sum()
}

/// Neighbouring groups to either side that a smooth law is averaged over.
const NEIGHBOURS: u16 = 3;

/// Mean offset of the neighbours of each group: the prediction of a smooth law.
pub fn smooth(
    sums: &BTreeMap<Group, GroupSums>,
    offsets: &BTreeMap<Group, f64>,
    how: GroupFit,
) -> BTreeMap<Group, f64> {
    let near = |k: Group| {
        let around = sums.range(k.around(NEIGHBOURS)).filter(|(g, _)| **g != k);
        let (sum, weight) = around.fold((0.0, 0.0), |(sum, weight), (g, s)| {
            let w = s.gram[2 * how.column].min(10.0 * how.precision);
            (sum + w * offsets[g], weight + w)
        });
        if weight > 0.0 { sum / weight } else { 0.0 }
    };
    sums.keys().map(|k| (*k, near(*k))).collect()
}

/// Mean offset of all groups.
fn level(sums: &BTreeMap<Group, GroupSums>, column: usize) -> f64 {
    let (right, gram) = sums.values().fold((0.0, 0.0), |(r, g), s| (r + s.right[column], g + s.gram[2 * column]));
    if gram > 0.0 { right / gram } else { 0.0 }
}

/// Gains of frames by offsets fitted on other folds and on other parts of each group: errors of the surfaces of one
/// part do not predict the other parts. With `rough`, gains are relative to those of a smooth law. Where the mean of
/// all groups is subtracted, it is that of each part.
pub fn cross_part_gains(
    frames: &[PartedFrame],
    select: &[usize],
    blocks: &[usize],
    how: GroupFit,
    rough: bool,
) -> Vec<f64> {
    let folds = fold_of(blocks);
    let mut out = vec![0.0; select.len()];
    for fold in 0..FOLDS {
        let train: Vec<_> = (0..select.len()).filter(|&i| folds[i] != fold).map(|i| &frames[select[i]]).collect();
        let mut parts: [_; PARTS] = std::array::from_fn(|part| total(train.iter().map(|f| &f[part])));
        let levels = parts.each_mut().map(|sums| {
            let level = if how.centred && !rough { level(sums, how.column) } else { 0.0 };
            sums.values_mut().for_each(|s| s.lower(how.column, level));
            level
        });
        for part in 0..PARTS {
            let mut others = BTreeMap::<Group, GroupSums>::new();
            for (_, sums) in parts.iter().enumerate().filter(|(p, _)| *p != part) {
                sums.iter().for_each(|(k, s)| others.entry(*k).or_default().merge(s));
            }
            let mut predicted = offsets(&others, how);
            predicted.values_mut().for_each(|v| *v *= how.trust);
            let smooth = if rough { smooth(&others, &predicted, how) } else { BTreeMap::new() };
            for i in (0..select.len()).filter(|&i| folds[i] == fold) {
                let mut frame = frames[select[i]][part].clone();
                frame.iter_mut().for_each(|(_, s)| s.lower(how.column, levels[part]));
                let frame = &frame;
                out[i] += gain(frame, how.column, &predicted) - gain(frame, how.column, &smooth);
            }
        }
    }
    out
}

/// Standard deviation of offsets from row to row, from the median second difference between neighbouring groups:
/// zero for offsets that are smooth except for a few jumps.
pub fn rough_spread(sums: &BTreeMap<Group, GroupSums>, offsets: &BTreeMap<Group, f64>, how: GroupFit) -> f64 {
    let is_known = |k: &Group| sums.get(k).is_some_and(|s| s.gram[2 * how.column] > 3.0 * how.precision);
    let known = |k: Group| offsets.get(&k).copied().filter(|_| is_known(&k));
    let second = |k: &Group| Some((known(*k)? - 0.5 * (known(k.previous()?)? + known(k.next())?)).abs());
    let differences: Vec<f64> = sums.keys().filter_map(second).collect();
    if differences.len() < 4 {
        return 0.0;
    }
    median(differences) / statistics::MEDIAN_OF_NORMAL / 1.5f64.sqrt()
}

/// Standard deviation of offsets about the mean of those up to `reach` groups away, beyond chance: zero for offsets
/// that are smooth over twice that reach.
pub fn spread_about(
    sums: &BTreeMap<Group, GroupSums>,
    offsets: &BTreeMap<Group, f64>,
    how: GroupFit,
    reach: u16,
) -> f64 {
    let known = known(sums, offsets, how);
    let about = |(k, (offset, noise)): (&Group, &(f64, f64))| {
        let around = known.range(k.around(reach));
        let (n, sum) = around.fold((0.0, 0.0), |(n, sum), (_, (o, _))| (n + 1.0, sum + o));
        // At the ends, and where many are not known, the mean is that of other ranges.
        (n >= f64::from(2 * reach)).then(|| (offset - sum / n).powi(2) - noise)
    };
    let squares: Vec<f64> = known.iter().filter_map(about).collect();
    let mean = squares.iter().sum::<f64>() / squares.len().max(1) as f64;
    if squares.len() < usize::from(2 * reach) { 0.0 } else { mean.max(0.0).sqrt() }
}

/// Groups with an offset of more than this many times the median variance are left out of spreads.
const WORSE: f64 = 16.0;

/// Offsets with their variances, of the groups that are known well.
fn known(
    sums: &BTreeMap<Group, GroupSums>,
    offsets: &BTreeMap<Group, f64>,
    how: GroupFit,
) -> BTreeMap<Group, (f64, f64)> {
    let known = sums.iter().filter(|(_, s)| s.gram[2 * how.column] > 3.0 * how.precision);
    let with_noise = |(k, s): (&Group, &GroupSums)| Some((*k, (*offsets.get(k)?, 1.0 / s.gram[2 * how.column])));
    best_known(known.filter_map(with_noise).collect())
}

/// Offsets with their variances, without those that are known much worse than the others.
fn best_known(mut known: BTreeMap<Group, (f64, f64)>) -> BTreeMap<Group, (f64, f64)> {
    let usual = median(known.values().map(|(_, noise)| *noise).collect());
    known.retain(|_, (_, noise)| *noise <= WORSE * usual);
    known
}

/// Root mean square of the offsets beyond their errors, and the number of groups that are known well. The `trimmed`
/// share with the largest offsets is left out.
pub fn spread(sums: &BTreeMap<Group, GroupSums>, how: GroupFit, trimmed: f64) -> (f64, f64) {
    spread_of(known(sums, &offsets(sums, how), how), trimmed)
}

fn spread_of(known: BTreeMap<Group, (f64, f64)>, trimmed: f64) -> (f64, f64) {
    let mut squares: Vec<(f64, f64)> = known.into_values().map(|(o, noise)| (o.powi(2), noise)).collect();
    squares.sort_by(|a, b| a.0.total_cmp(&b.0));
    squares.truncate(((1.0 - trimmed) * squares.len() as f64).ceil() as usize);
    let n = squares.len() as f64;
    let excess: f64 = squares.iter().map(|(square, noise)| square - noise).sum();
    if n < 4.0 { (0.0, 0.0) } else { ((excess / n).max(0.0).sqrt(), n) }
}

/// Ratio of the spread to the spread about the neighbours above which rows are shifted together.
const TOGETHER: f64 = 1.12;

/// The same for rows, from their offsets with variances. A displaced wall shifts many rows together. Where the spread
/// about the mean of the neighbours is significantly smaller than for independent rows, it is returned.
pub fn spread_of_rows(rows: &BTreeMap<Group, [f64; 2]>) -> (f64, f64) {
    let known = best_known(rows.iter().map(|(k, [offset, noise])| (*k, (*offset, *noise))).collect());
    let about = |(k, (offset, noise)): (&Group, &(f64, f64))| {
        let around = known.range(k.around(NEIGHBOURS)).filter(|(g, _)| *g != k);
        let (n, sum, of_mean) = around.fold((0.0, 0.0, 0.0), |(n, sum, v), (_, (o, e))| (n + 1.0, sum + o, v + e));
        (n > 1.0).then(|| ((offset - sum / n).powi(2) - noise - of_mean / (n * n)) / (1.0 + 1.0 / n))
    };
    let squares: Vec<f64> = known.iter().filter_map(about).collect();
    let n = squares.len() as f64;
    let about_neighbours = (squares.iter().sum::<f64>() / n.max(1.0)).max(0.0).sqrt();
    let whole = spread_of(known, 0.0);
    if n >= 4.0 && whole.0 > TOGETHER * about_neighbours { (about_neighbours, n) } else { whole }
}

/// Standard deviation of offsets of rows that may be wrong along a line, and the number of them: the root mean square
/// by what is known of each row, its offset as it was shrunk, with its variance. Shrunk offsets alone are too small by
/// just that variance.
pub fn spread_of_smooth_rows(rows: &BTreeMap<Group, [f64; 2]>) -> (f64, f64) {
    let known = best_known(rows.iter().map(|(k, [offset, variance])| (*k, (*offset, *variance))).collect());
    let n = known.len() as f64;
    let squares: f64 = known.values().map(|(offset, variance)| offset.powi(2) + variance).sum();
    if n < 4.0 { (0.0, 0.0) } else { ((squares / n).sqrt(), n) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand_distr::{Distribution, StandardNormal};

    #[test]
    fn offsets_about_their_neighbours_are_those_that_are_not_smooth() {
        let how = GroupFit { column: 0, precision: 1.0, centred: true, trust: 1.0 };
        let spread = |of: &dyn Fn(f64) -> f64| {
            let group = |k: u16| {
                let gram = 1e6;
                let sums =
                    GroupSums { gram: [gram, 0.0, 0.0], right: [gram * of(f64::from(k)), 0.0], ..GroupSums::default() };
                (row(k), sums)
            };
            let sums: BTreeMap<Group, GroupSums> = (0..80).map(group).collect();
            spread_about(&sums, &offsets(&sums, how), how, 8)
        };
        // A line, and half of a sine of eight groups.
        assert!(spread(&|k| 0.01 * k) < 1e-3);
        let wave = spread(&|k| 0.01 * k + 0.05 * (std::f64::consts::TAU * k / 8.0).sin());
        assert!((wave - 0.05 / 2f64.sqrt()).abs() < 0.004, "{wave}");
    }

    fn row(index: u16) -> Group {
        Group { sensor: 0, index }
    }

    #[test]
    fn offsets_and_their_spread_are_found_and_noise_gains_nothing() {
        let mut rng = data::stream(3, "grouped", 0, 0);
        // Offsets of groups, and an error of the surfaces of one part.
        let mut made = |size: f64, of_a_part: f64| -> Vec<PartedFrame> {
            let mut group = |k: u16, part: usize| {
                let own = if k.is_multiple_of(2) { size } else { -size };
                let truth = own + if part == 1 && k > 9 { of_a_part } else { 0.0 };
                let noise: f64 = StandardNormal.sample(&mut rng);
                let w = 100.0;
                (row(k), GroupSums { gram: [w, 0.0, 0.0], right: [w * (truth + 0.1 * noise), 0.0], n: 1.0, weight: w })
            };
            (0..16).map(|_| std::array::from_fn(|part| (0..20).map(|k| group(k, part)).collect())).collect()
        };
        let how = GroupFit { column: 0, precision: 1.0, centred: true, trust: 1.0 };
        let select: Vec<usize> = (0..16).collect();
        let all = |frames: &[PartedFrame]| total(frames.iter().flatten());
        let rough = |sums: &BTreeMap<Group, GroupSums>| rough_spread(sums, &offsets(sums, how), how);
        for of_rows in [false, true] {
            let frames = made(0.05, 0.0);
            assert!(cross_part_gains(&frames, &select, &select, how, of_rows).iter().sum::<f64>() > 50.0);
            assert!((spread(&all(&frames), how, 0.0).0 - 0.05).abs() < 0.01);
            // Neighbours differ by twice the offset each time.
            assert!((rough(&all(&frames)) - 0.12).abs() < 0.03, "{}", rough(&all(&frames)));
            let nothing = made(0.0, 0.0);
            assert!(cross_part_gains(&nothing, &select, &select, how, of_rows).iter().sum::<f64>() < 5.0);
            let surface = made(0.0, 0.2);
            assert!(cross_part_gains(&surface, &select, &select, how, of_rows).iter().sum::<f64>() < 5.0);
            assert!(rough(&all(&surface)) < 0.02);
        }
    }

    #[test]
    fn shifts_of_many_rows_by_a_wall_are_no_spread_of_rows() {
        let mut rng = data::stream(5, "rows", 0, 0);
        let offsets: Vec<f64> =
            (0..200).map(|_| 0.05 * Distribution::<f64>::sample(&StandardNormal, &mut rng)).collect();
        let how = GroupFit { column: 0, precision: 1.0, centred: true, trust: 1.0 };
        let with_step = |step: f64| -> BTreeMap<Group, GroupSums> {
            let w = 1e6;
            let at = |k: usize| offsets[k] + if k < 100 { 0.0 } else { step };
            (0..200)
                .map(|k| (row(k as u16), GroupSums { gram: [w, 0.0, 0.0], right: [w * at(k), 0.0], n: 1.0, weight: w }))
                .collect()
        };
        let rows = |step: f64| {
            let sums = with_step(step);
            let offsets = super::offsets(&sums, how);
            spread_of_rows(&offsets.into_iter().map(|(row, v)| (row, [v, 1.0 / sums[&row].gram[0]])).collect())
        };
        assert_eq!(rows(0.0), spread(&with_step(0.0), how, 0.0));
        assert!((spread(&with_step(0.2), how, 0.0).0 - 0.11).abs() < 0.01);
        assert!((rows(0.2).0 - 0.05).abs() < 0.01, "{:?}", rows(0.2));
    }

    #[test]
    fn the_spread_of_smooth_rows_does_not_depend_on_how_well_they_are_known() {
        let mut rng = data::stream(5, "rows", 0, 0);
        let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
        for noise in [0.0f64, 0.03, 0.06] {
            let shrink = 0.05f64.powi(2) / (0.05f64.powi(2) + noise.powi(2));
            let mut of_row = |k| (row(k), [shrink * (0.05 * normal() + noise * normal()), shrink * noise.powi(2)]);
            let (spread, n) = spread_of_smooth_rows(&(0..400).map(&mut of_row).collect());
            assert!(n == 400.0 && (spread - 0.05).abs() < 0.005, "{spread} {noise}");
        }
        assert_eq!(spread_of_smooth_rows(&BTreeMap::from([(row(0), [1.0, 0.1])])), (0.0, 0.0));
    }
}
