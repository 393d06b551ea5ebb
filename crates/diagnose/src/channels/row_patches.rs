//! Offsets of rows against the rows beside them. A surface of the simulation may stand a little elsewhere, or lean:
//! over a few rows that meet it side by side this is an offset and a slope along it, which are integrated out. What is
//! left belongs to the rows.

use super::groups::{Group, PARTS, Seen, part_of};
use super::mean::{GROUND, KINDS, kind_of, usable, weight};
use super::own_poses::{OwnPoses, mounts};
use crate::inference::banded::Cholesky;
use crate::pairing::{FramePair, Surface};
use nalgebra::{Matrix2, Vector2};
use rayon::prelude::*;
use sensor::Rig;
use std::collections::BTreeMap;

/// Rows of a patch.
const WIDE: usize = 6;

/// Rows from one patch to the next: every row is in two of them.
const STEP: usize = 3;

/// Width of a patch, rad.
const AZIMUTH_RAD: f64 = 0.12;

/// Largest extent of a patch along its surface, m: farther away a surface is not even.
const LONG_M: f64 = 12.0;

/// Fewest rows of a patch: two are needed for its offset and slope.
const FEWEST_ROWS: usize = 3;

/// Fewest returns of a row in a patch.
const FEWEST: f64 = 3.0;

/// Priors of the offsets of rows that are tried: each has half the standard deviation of the one before.
const PRIORS: i32 = 7;

/// Columns: offset of the range, m, and of the elevation, rad.
const COLUMNS: usize = 2;

/// Offsets of rows by column.
pub type Offsets = [Vec<f64>; COLUMNS];

/// Products of the offsets of rows with those of the rows after them, up to the width of a patch, column by column, and
/// with what is measured.
#[derive(Clone, Debug, Default)]
pub struct Band {
    gram: Vec<[[[f64; COLUMNS]; COLUMNS]; WIDE]>,
    right: Vec<[f64; COLUMNS]>,
    weight: Vec<f64>,
}

impl Band {
    /// Room for a row.
    fn grow(&mut self, rows: usize) {
        if self.right.len() < rows {
            self.gram.resize(rows, Default::default());
            self.right.resize(rows, [0.0; COLUMNS]);
            self.weight.resize(rows, 0.0);
        }
    }

    /// Adds another one.
    pub fn merge(&mut self, other: &Band) {
        self.add(other, 1.0);
    }

    /// The sums without those of a part of the returns.
    pub fn without(mut self, part: &Band) -> Band {
        self.add(part, -1.0);
        self
    }

    fn add(&mut self, other: &Band, times: f64) {
        self.grow(other.right.len());
        for (row, (gram, right)) in other.gram.iter().zip(&other.right).enumerate() {
            for (a, b) in pairs() {
                (0..WIDE).for_each(|k| self.gram[row][k][a][b] += times * gram[k][a][b]);
            }
            (0..COLUMNS).for_each(|c| self.right[row][c] += times * right[c]);
            self.weight[row] += times * other.weight[row];
        }
    }

    /// Offsets of the rows in some columns, fitted together, with the prior precision of each; 0 in those without one.
    pub fn offsets(&self, precision: [Option<f64>; COLUMNS]) -> Offsets {
        self.fitted(precision, 1.0).0
    }

    /// The likeliest prior precisions of those of some standard deviations: the `widest` and halves, quarters and so on
    /// of them. They are in units of the variance of what is measured, which is `variance`. Rows that are known worse
    /// than they scatter would predict what is chance.
    pub fn likeliest(&self, widest: [Option<f64>; COLUMNS], variance: f64) -> [Option<f64>; COLUMNS] {
        let halved = |k: i32| widest.map(|precision| precision.map(|p| p * 4f64.powi(k)));
        let tried = (0..PRIORS).map(|k| (halved(k), self.fitted(halved(k), variance).1));
        tried.max_by(|a, b| a.1.total_cmp(&b.1)).map_or(widest, |(precision, _)| precision)
    }

    /// What another band is likelier by with offsets as far as this one knows them, for the prior precision of each
    /// column, than without any, nats. Offsets that are hardly known predict next to nothing.
    pub fn predicts(&self, other: &Band, precision: [Option<f64>; COLUMNS], variance: f64) -> f64 {
        let mut both = self.clone();
        both.merge(other);
        both.fitted(precision, variance).1 - self.fitted(precision, variance).1
    }

    /// Offsets of the rows in some columns, for the prior precision of each, with the logarithm of what is measured
    /// being likelier with such offsets than without any; 0 and impossible where they cannot be solved for.
    fn fitted(&self, precision: [Option<f64>; COLUMNS], variance: f64) -> (Offsets, f64) {
        let rows = self.right.len();
        let fitted: Vec<(usize, f64)> =
            precision.iter().enumerate().filter_map(|(c, precision)| Some((c, (*precision)?))).collect();
        let mut out: Offsets = std::array::from_fn(|_| vec![0.0; rows]);
        let each = fitted.len();
        if each == 0 {
            return (out, 0.0);
        }
        let element = |i: usize, j: usize| {
            let ((a, precision), (b, _)) = (fitted[i % each], fitted[j % each]);
            let apart = i / each - j / each;
            let shared = if apart < WIDE { self.gram[j / each][apart][b][a] } else { 0.0 };
            shared + if i == j { precision } else { 0.0 }
        };
        let right: Vec<f64> = (0..rows * each).map(|i| self.right[i / each][fitted[i % each].0]).collect();
        let Some(cholesky) = Cholesky::new(right.len(), WIDE * each - 1, element) else {
            return (out, f64::NEG_INFINITY);
        };
        let solved = cholesky.solve(&right);
        for (i, offset) in solved.iter().enumerate() {
            out[fitted[i % each].0][i / each] = *offset;
        }
        let of_priors = rows as f64 * fitted.iter().map(|(_, precision)| precision.ln()).sum::<f64>();
        let squares: f64 = right.iter().zip(&solved).map(|(right, offset)| right * offset).sum();
        (out, 0.5 * (of_priors - cholesky.ln_determinant() + squares / variance))
    }

    /// Gain by offsets, nats.
    pub fn gain(&self, offsets: &Offsets) -> f64 {
        let of = |row: usize, column: usize| offsets[column].get(row).copied().unwrap_or(0.0);
        let of_row = |row: usize| -> f64 {
            let beside = |(a, b): (usize, usize)| -> f64 {
                let same = 0.5 * self.gram[row][0][a][b] * of(row, b);
                let others = (1..WIDE).map(|k| self.gram[row][k][a][b] * of(row + k, b)).sum::<f64>();
                of(row, a) * (same + others)
            };
            let measured: f64 = (0..COLUMNS).map(|c| of(row, c) * self.right[row][c]).sum();
            measured - pairs().map(beside).sum::<f64>()
        };
        (0..self.right.len()).map(of_row).sum()
    }

    /// Number of rows, those without returns among them.
    pub fn rows(&self) -> usize {
        self.right.len()
    }

    /// Mean squared lever of the offset of a row in one column, without the part that its patches absorb.
    pub fn squared_lever(&self, row: usize, column: usize) -> f64 {
        self.precision(row, column) / self.weight.get(row).map_or(1.0, |w| w.max(1e-12))
    }

    /// Information about the offset of a row in one column.
    pub fn precision(&self, row: usize, column: usize) -> f64 {
        self.gram.get(row).map_or(0.0, |g| g[0][column][column])
    }
}

/// All pairs of columns.
fn pairs() -> impl Iterator<Item = (usize, usize)> {
    (0..COLUMNS).flat_map(|a| (0..COLUMNS).map(move |b| (a, b)))
}

/// Sums of one frame by sensor and part.
#[derive(Clone, Debug, Default)]
pub struct RowFrame {
    /// By sensor.
    pub sensors: Vec<[Band; PARTS]>,
    /// The same of surfaces that stand.
    pub standing: Vec<[Band; PARTS]>,
    /// Squares that the patches leave, in units of the assumed variance.
    pub squares: f64,
    /// Degrees of freedom of these squares.
    pub freedom: f64,
}

/// Sums of the returns of one row in one patch: weights, by both levers, their squares, and by what is measured.
#[derive(Clone, Copy, Debug, Default)]
struct Cell {
    n: f64,
    w: f64,
    /// Place along the surface, m: distance on the ground, height on what stands.
    place_m: f64,
    wx: [f64; COLUMNS],
    wxx: [[f64; COLUMNS]; COLUMNS],
    wy: f64,
    wxy: [f64; COLUMNS],
    wyy: f64,
}

/// The sums of all frames. Offsets of surfaces are integrated out.
pub fn row_frames(frames: &[FramePair], rig: &Rig, seen: Seen, noise_m: f64) -> Vec<RowFrame> {
    let mounts = mounts(rig);
    let turns: Vec<_> = rig.sensors.iter().map(|s| s.pose().rotation).collect();
    let half_fov: Vec<f64> = rig.sensors.iter().map(|s| s.half_fov_rad()).collect();
    let one = |(frame, poses): (&FramePair, &OwnPoses)| {
        // By sensor, part, azimuth and kind of surface: the rows.
        let mut strips = BTreeMap::<(usize, usize, i32, usize), BTreeMap<usize, Cell>>::new();
        for ray in frame.measured.iter().filter(|r| usable(r) && r.row != u16::MAX) {
            let sensor = ray.sensor as usize;
            let Some((y, x)) = seen.across(ray, poses, &mounts[sensor], &turns[sensor]) else { continue };
            let part = part_of(ray, super::groups::Grouping::Row, half_fov[sensor]);
            let at = ray.direction_vector() * f64::from(ray.range_m);
            let strip = (at.y.atan2(at.x) / AZIMUTH_RAD).floor() as i32;
            let rows = strips.entry((sensor, part, strip, kind_of(ray).min(KINDS - 1))).or_default();
            let place_m = if ray.surface == Surface::Ground { at.xy().norm() } else { at.z };
            rows.entry(usize::from(ray.row)).or_default().add(place_m, x, y, weight(ray, noise_m));
        }
        let mut out = RowFrame::new(rig.sensors.len());
        for ((sensor, part, _, kind), rows) in strips {
            let last = rows.keys().next_back().copied().unwrap_or(0);
            for from in (0..=last).step_by(STEP) {
                // The first rows are in one patch alone otherwise.
                let from = from as i64 - STEP as i64;
                let within = from.max(0) as usize..(from + WIDE as i64).max(0) as usize;
                let cells: Vec<(usize, Cell)> =
                    rows.range(within).filter(|(_, c)| c.n >= FEWEST).map(|(r, c)| (*r, *c)).collect();
                let cells = even(&cells);
                if cells.len() >= FEWEST_ROWS {
                    add_patch(&mut out, cells, (sensor, part, kind));
                }
            }
        }
        out
    };
    frames.par_iter().zip(seen.poses).map(one).collect()
}

impl Cell {
    fn add(&mut self, place_m: f64, x: [f64; COLUMNS], y: f64, w: f64) {
        self.n += 1.0;
        self.place_m += place_m;
        self.w += w;
        self.wy += w * y;
        self.wyy += w * y * y;
        for (c, x) in x.into_iter().enumerate() {
            self.wx[c] += w * x;
            self.wxy[c] += w * x * y;
        }
        pairs().for_each(|(a, b)| self.wxx[a][b] += w * x[a] * x[b]);
    }
}

/// Place of a row of a patch along the surface, m.
fn along(cell: &Cell) -> f64 {
    cell.place_m / cell.n
}

/// The most rows beside each other that are near enough to each other for an even surface; of several the first.
fn even(cells: &[(usize, Cell)]) -> &[(usize, Cell)] {
    let extent = |cells: &[(usize, Cell)]| {
        let places = || cells.iter().map(|(_, c)| along(c));
        places().fold(f64::NEG_INFINITY, f64::max) - places().fold(f64::INFINITY, f64::min)
    };
    let runs = (0..cells.len()).map(|from| {
        let ends = (from + 1..=cells.len()).take_while(|to| extent(&cells[from..*to]) <= LONG_M);
        &cells[from..ends.last().unwrap_or(from)]
    });
    runs.rev().max_by_key(|run| run.len()).unwrap_or(cells)
}

impl RowFrame {
    fn new(sensors: usize) -> RowFrame {
        RowFrame {
            sensors: vec![Default::default(); sensors],
            standing: vec![Default::default(); sensors],
            ..RowFrame::default()
        }
    }
}

/// Adds a patch with its offset and slope integrated out, with half of its weight: its rows are in another one as well.
fn add_patch(frame: &mut RowFrame, cells: &[(usize, Cell)], (sensor, part, kind): (usize, usize, usize)) {
    let middle = cells.iter().map(|(_, c)| along(c)).sum::<f64>() / cells.len() as f64;
    let place = |cell: &Cell| Vector2::new(1.0, along(cell) - middle);
    let mut own = Matrix2::zeros();
    let mut of_own = Vector2::zeros();
    for (_, c) in cells {
        own += place(c) * place(c).transpose() * c.w;
        of_own += place(c) * c.wy;
    }
    let Some(inverse) = own.try_inverse() else { return };
    // Between the means of rows, as the patch is made of them: the scatter within a row is not that of the surface.
    let of_means: f64 = cells.iter().map(|(_, c)| c.wy * c.wy / c.w).sum();
    frame.squares += 0.5 * (of_means - of_own.dot(&(inverse * of_own)));
    frame.freedom += 0.5 * (cells.len() as f64 - 2.0);
    let mut bands = vec![&mut frame.sensors[sensor][part]];
    bands.extend((kind != GROUND).then_some(&mut frame.standing[sensor][part]));
    for band in bands {
        add_to_band(band, cells, &inverse, &of_own, &place);
    }
}

fn add_to_band(
    band: &mut Band,
    cells: &[(usize, Cell)],
    inverse: &Matrix2<f64>,
    of_own: &Vector2<f64>,
    place: &dyn Fn(&Cell) -> Vector2<f64>,
) {
    band.grow(cells.last().map_or(0, |(r, _)| r + 1));
    for (i, (row, c)) in cells.iter().enumerate() {
        band.weight[*row] += 0.5 * c.w;
        for a in 0..COLUMNS {
            let across = inverse * place(c) * c.wx[a];
            band.right[*row][a] += 0.5 * (c.wxy[a] - across.dot(of_own));
            for ((other, o), b) in cells[i..].iter().flat_map(|o| (0..COLUMNS).map(move |b| (o, b))) {
                let same = if other == row { c.wxx[a][b] } else { 0.0 };
                band.gram[*row][other - row][a][b] += 0.5 * (same - across.dot(&(place(o) * o.wx[b])));
            }
        }
    }
}

/// Sums over frames and some parts of one sensor.
pub fn total<'a>(frames: impl Iterator<Item = &'a RowFrame>, sensor: usize, parts: &dyn Fn(usize) -> bool) -> Band {
    total_of(frames.map(|frame| &frame.sensors[..]), sensor, parts)
}

/// The same of surfaces that stand.
pub fn standing<'a>(frames: impl Iterator<Item = &'a RowFrame>, sensor: usize, parts: &dyn Fn(usize) -> bool) -> Band {
    total_of(frames.map(|frame| &frame.standing[..]), sensor, parts)
}

fn total_of<'a>(
    frames: impl Iterator<Item = &'a [[Band; PARTS]]>,
    sensor: usize,
    parts: &dyn Fn(usize) -> bool,
) -> Band {
    let mut sum = Band::default();
    for frame in frames {
        let Some(of_sensor) = frame.get(sensor) else { continue };
        (0..PARTS).filter(|p| parts(*p)).for_each(|p| sum.merge(&of_sensor[p]));
    }
    sum
}

/// The group of a row.
pub fn group(sensor: usize, row: usize) -> Group {
    Group { sensor: sensor as u8, index: row as u16 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand_distr::{Distribution, StandardNormal};

    /// A frame of patches with an offset and a slope each, and rows with an offset of 1 cm, in turn longer and shorter.
    fn frame(rng: &mut data::Stream, row_m: f64) -> RowFrame {
        let mut frame = RowFrame::new(1);
        let mut normal = || -> f64 { StandardNormal.sample(rng) };
        for part in 0..PARTS {
            for from in (0..24).step_by(STEP) {
                let (offset, slope) = (0.05 * normal(), 0.01 * normal());
                let cells: Vec<(usize, Cell)> = (from..from + WIDE)
                    .map(|row| {
                        let mut cell = Cell::default();
                        let own = if row.is_multiple_of(2) { row_m } else { -row_m };
                        for _ in 0..10 {
                            let y = offset + slope * row as f64 - own + 0.02 * normal();
                            cell.add(0.5 * row as f64, [-1.0, -10.0], y, 1.0 / (0.02 * 0.02));
                        }
                        (row, cell)
                    })
                    .collect();
                add_patch(&mut frame, &cells, (0, part, 1));
            }
        }
        frame
    }

    #[test]
    fn rows_far_apart_are_no_patch_and_the_others_are() {
        let cells = |places: &[f64]| -> Vec<(usize, Cell)> {
            let cell = |place_m: &f64| Cell { n: 1.0, place_m: *place_m, ..Cell::default() };
            places.iter().map(cell).enumerate().collect()
        };
        let rows = |places: &[f64]| even(&cells(places)).iter().map(|(row, _)| *row).collect::<Vec<_>>();
        assert_eq!(rows(&[5.1, 6.2, 7.8, 10.1, 13.7, 19.9]), [0, 1, 2, 3, 4]);
        assert_eq!(rows(&[7.8, 10.1, 13.7, 19.9, 32.6]), [0, 1, 2]);
        assert_eq!(rows(&[3.0, 20.0, 2.0, 1.5]), [2, 3]);
        assert!(rows(&[]).is_empty());
    }

    #[test]
    fn rows_are_found_beneath_errors_of_the_surfaces() {
        let mut rng = data::stream(4, "row patches", 0, 0);
        let frames: Vec<RowFrame> = (0..20).map(|_| frame(&mut rng, 0.01)).collect();
        let only = [Some(100.0), None];
        let train = total(frames[..10].iter(), 0, &|_| true);
        let offsets = train.offsets(only);
        // An offset and a slope of all rows are not known.
        for (row, next) in offsets[0].windows(3).enumerate().take(22) {
            let bend = next[0] - 2.0 * next[1] + next[2];
            let own = if row.is_multiple_of(2) { 0.04 } else { -0.04 };
            assert!((bend - own).abs() < 0.006, "{row} {bend}");
        }
        let test = total(frames[10..].iter(), 0, &|_| true);
        assert!(test.gain(&offsets) > 100.0, "{}", test.gain(&offsets));
        // Both columns together explain no more than the one that is there.
        let both = test.gain(&train.offsets([Some(100.0), Some(1e4)]));
        assert!((both / test.gain(&offsets) - 1.0).abs() < 0.05, "{both}");
        // What is known is gained, but for what it costs to be uncertain; the likeliest prior gains no less.
        let gained = train.predicts(&test, only, 1.0);
        assert!((gained / test.gain(&offsets) - 1.0).abs() < 0.1, "{gained} {}", test.gain(&offsets));
        let wide = [Some(1e-2), None];
        assert!(train.predicts(&test, train.likeliest(wide, 1.0), 1.0) >= train.predicts(&test, wide, 1.0));
        let nothing: Vec<RowFrame> = (0..20).map(|_| frame(&mut rng, 0.0)).collect();
        let [train, test] = [&nothing[..10], &nothing[10..]].map(|frames| total(frames.iter(), 0, &|_| true));
        assert!(train.predicts(&test, wide, 1.0) < 0.0);
        let gained = train.predicts(&test, train.likeliest(only, 1.0), 1.0);
        assert!((-8.0..2.0).contains(&gained), "{gained}");
        // What the patches leave is the noise.
        let [squares, freedom] = nothing.iter().fold([0.0; 2], |s, f| [s[0] + f.squares, s[1] + f.freedom]);
        assert!((squares / freedom - 1.0).abs() < 0.1, "{}", squares / freedom);
    }
}
