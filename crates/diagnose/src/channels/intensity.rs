//! Intensities: the logarithm of each measured intensity over the mean of the simulated ones on the same surface, in
//! the same direction. Reflectivities of the world cancel; what is left is how the sensor makes a number of the light.
//!
//! The same ratio of each simulated return to its simulated neighbours shows what the averaging does by itself.

use super::groups::{Group, GroupSums, Grouping, PARTS, PartedFrame, group_of, part_of};
use crate::inference::linear::{LinearFrame, fit};
use crate::pairing::{FramePair, Lies, Ray, Surface};
use nalgebra::{DMatrix, DVector, SMatrix, SVector};
use rayon::prelude::*;
use sensor::Rig;
use std::collections::BTreeMap;

/// Columns of the law: a factor, ln(range / [`REFERENCE_M`]), ln(cos), ln(intensity) from its mean; then factors of
/// standing surfaces and of objects, which belong to the world.
pub const COLUMNS: usize = 6;

/// Column of the factor.
pub const GAIN: usize = 0;

/// Column of range.
pub const RANGE: usize = 1;

/// Column of incidence.
pub const COS: usize = 2;

/// Column of the simulated intensity.
pub const BRIGHTNESS: usize = 3;

/// Columns of the world: reflectivities of kinds of surfaces relative to that of the ground.
pub const OF_THE_WORLD: [usize; 2] = [4, 5];

/// Range at which the law of range is 1, m.
pub const REFERENCE_M: f64 = 20.0;

/// Neighbouring returns share the errors of a surface: so many count as one.
const DESIGN: f64 = 4.0;

/// Smallest standard deviation of the logarithm of a ratio: what averaging over neighbours does.
const LEAST_STD: f64 = 0.01;

/// Number of bins of ln(intensity) of the simulated side.
const BINS: usize = 24;

/// Largest deviation of the logarithm of a ratio from the median of its bin that counts.
const CAP: f64 = 2.0;

/// Largest share of a bin's measured or simulated intensities that may be saturated, or below [`STEPS`] steps.
const CENSORED: f64 = 0.02;

/// Smallest intensity that is used, in steps of the column: rounding displaces the logarithm of smaller ones.
const STEPS: f64 = 6.0;

/// Most distinct values of a column of which the step is searched.
const MOST_VALUES: usize = 5000;

/// Share of the returns at the largest value from which on the column saturates.
const SATURATED: f64 = 0.002;

/// Fewest rays with an intensity on both sides.
const FEWEST: usize = 2000;

/// Logarithm of the intensity of a ray over that of the simulated returns around it; `None` without both.
pub fn ln_ratio(ray: &Ray) -> Option<f64> {
    let (own, simulated) = (f64::from(ray.intensity), f64::from(ray.intensity_simulated));
    (ray.lies() == Lies::On && ray.smooth && own > 0.0 && simulated > 0.0).then(|| (own / simulated).ln())
}

/// How a column of intensities is written.
#[derive(Clone, Copy, Debug, PartialEq, Default)]
pub struct Column {
    /// Step between values; 0 if there is none.
    pub step: f64,
    /// Value at which it saturates; 0 if it does not.
    pub most: f64,
    /// Correlation of the logarithms of a return's intensity and of those beside it: 1 for surfaces, 0 for noise.
    pub of_surfaces: f64,
    /// Whether all values are the same.
    pub constant: bool,
}

impl Column {
    /// Of the rays of one side.
    pub fn of<'a>(rays: impl Iterator<Item = &'a Ray> + Clone) -> Column {
        let mut values: Vec<f32> = rays.clone().map(|r| r.intensity).filter(|v| v.is_finite()).collect();
        values.sort_by(f32::total_cmp);
        let (n, last) = (values.len().max(1), values.last().copied().unwrap_or(0.0));
        let at_last = values.iter().rev().take_while(|v| **v == last).count();
        let constant = values.first() == values.last();
        values.dedup();
        let gaps = values.windows(2).map(|w| f64::from(w[1] - w[0])).filter(|gap| *gap > 1e-6 * f64::from(last));
        let rounded = values.len() <= MOST_VALUES;
        Column {
            step: if rounded && !constant { gaps.fold(f64::MAX, f64::min) } else { 0.0 },
            most: if at_last as f64 / n as f64 > SATURATED && !constant { f64::from(last) } else { 0.0 },
            of_surfaces: correlation(rays.filter_map(|r| {
                let [own, beside] = [r.intensity, r.intensity_beside].map(f64::from);
                (own > 0.0 && beside > 0.0).then(|| (own.ln(), beside.ln()))
            })),
            constant,
        }
    }

    /// Logarithm of a value; of one below half a step, that of half a step.
    fn ln(&self, value: f64) -> f64 {
        value.max(0.5 * self.step).max(1e-9).ln()
    }

    /// Whether a value is too small or too large to be used.
    fn censors(&self, value: f64) -> bool {
        value <= 0.0 || value < STEPS * self.step || self.most > 0.0 && value >= self.most
    }

    /// Whether intensities tell surfaces apart.
    pub fn tells_surfaces(&self) -> bool {
        !self.constant && self.of_surfaces > OF_SURFACES
    }
}

/// Correlation of neighbours from which on a column tells surfaces apart.
const OF_SURFACES: f64 = 0.25;

fn correlation(pairs: impl Iterator<Item = (f64, f64)>) -> f64 {
    let mut s = [0.0; 6];
    for (x, y) in pairs {
        [1.0, x, y, x * x, y * y, x * y].iter().zip(&mut s).for_each(|(v, sum)| *sum += v);
    }
    let [n, x, y, xx, yy, xy] = s;
    let (vx, vy, c) = (xx / n - (x / n).powi(2), yy / n - (y / n).powi(2), xy / n - x * y / (n * n));
    if n > 2.0 && vx > 1e-12 && vy > 1e-12 { c / (vx * vy).sqrt() } else { 0.0 }
}

/// Columns of both sides of the smooth rays of all frames, measured first; `None` where a side has no intensities.
pub fn columns(frames: &[FramePair]) -> Option<[Column; 2]> {
    fn rays(frames: &[FramePair], measured: bool) -> impl Iterator<Item = &Ray> + Clone {
        let rays = frames.iter().flat_map(move |f| if measured { &f.measured } else { &f.simulated });
        rays.filter(|r| r.smooth && r.intensity.is_finite())
    }
    let side = |measured| rays(frames, measured);
    let enough = side(true).nth(FEWEST).is_some() && side(false).nth(FEWEST).is_some();
    enough.then(|| [Column::of(side(true)), Column::of(side(false))])
}

/// Bins of ln(intensity) of the simulated side.
#[derive(Clone, Copy, Debug)]
struct Bins {
    low: f64,
    width: f64,
}

impl Bins {
    /// The bin of a logarithm; `None` beyond both ends.
    fn of(&self, ln: f64) -> Option<usize> {
        let bin = ((ln - self.low) / self.width).floor();
        (bin >= 0.0 && bin < BINS as f64).then_some(bin as usize)
    }

    fn middle(&self, bin: usize) -> f64 {
        self.low + (bin as f64 + 0.5) * self.width
    }
}

/// Both sides on one scale: which simulated intensities are used, and how they are centred.
#[derive(Clone, Debug)]
pub struct Scale {
    /// Columns of both sides, measured first.
    pub columns: [Column; 2],
    /// Mean of ln(simulated intensity) of the used rays.
    pub centre: f64,
    /// Standard deviation of ln(simulated intensity) of the used rays.
    pub spread: f64,
    /// Root mean square of what rounding of both columns does to the logarithm of a ratio. All rays of a row that meet
    /// one evenly bright surface are rounded alike.
    pub rounding: f64,
    bins: Bins,
    /// Median of ln(ratio) in each bin of the simulated intensity; NaN in bins that are not used.
    median: Vec<f64>,
    /// Weight of a ray.
    weight: f64,
    /// What averaging over neighbours does to the simulated side.
    averaging: SVector<f64, COLUMNS>,
    /// What it does beyond that to single rows: brightness that is curved over the rows has another mean.
    averaging_of_rows: BTreeMap<Group, f64>,
}

/// A ray that is used.
pub struct Sample {
    /// Its columns.
    pub x: SVector<f64, COLUMNS>,
    /// Logarithm of its ratio, without what averaging does.
    pub y: f64,
    /// Its weight.
    pub weight: f64,
    /// Bin of its simulated intensity.
    bin: usize,
}

#[derive(Default)]
struct Sums {
    gram: SMatrix<f64, COLUMNS, COLUMNS>,
    right: SVector<f64, COLUMNS>,
}

impl Sums {
    fn add(&mut self, s: &Sample) {
        self.gram.ger(s.weight, &s.x, &s.x, 1.0);
        self.right.axpy(s.weight * s.y, &s.x, 1.0);
    }

    fn frame(&self) -> LinearFrame {
        LinearFrame {
            gram: DMatrix::from_fn(COLUMNS, COLUMNS, |i, j| self.gram[(i, j)]),
            right: DVector::from_fn(COLUMNS, |i, _| self.right[i]),
        }
    }
}

impl Scale {
    /// From some frames; `None` where too few rays can be compared.
    pub fn new(frames: &[&FramePair], columns: [Column; 2]) -> Option<Scale> {
        let both = |f: &FramePair| -> Vec<[f64; 2]> {
            let rays = f.measured.iter().filter(|r| r.smooth && r.lies() == Lies::On);
            let pair = rays.map(|r| [f64::from(r.intensity), f64::from(r.intensity_simulated)]);
            pair.filter(|v| v[0].is_finite() && v[1] > 0.0).collect()
        };
        let pairs: Vec<[f64; 2]> = frames.iter().flat_map(|f| both(f)).collect();
        if pairs.len() < FEWEST {
            return None;
        }
        let mut ln: Vec<f64> = pairs.iter().map(|v| v[1].ln()).collect();
        ln.sort_by(f64::total_cmp);
        let (low, high) = (ln[ln.len() / 200], ln[ln.len() - 1 - ln.len() / 200]);
        let width = ((high - low) / BINS as f64).max(1e-6);
        let bins = Bins { low, width };
        let mut ratios: Vec<Vec<f64>> = vec![Vec::new(); BINS];
        let mut censored = [0usize; BINS];
        let mut rounding = [0.0; BINS];
        for [own, simulated] in pairs {
            let Some(b) = bins.of(simulated.ln()) else { continue };
            censored[b] += usize::from(columns[0].censors(own) || columns[1].censors(simulated));
            let share = |value: f64, column: &Column| (column.step / value.max(1e-9)).min(1.0).powi(2) / 12.0;
            rounding[b] += share(own, &columns[0]) + share(simulated, &columns[1]);
            ratios[b].push(columns[0].ln(own) - simulated.ln());
        }
        let used = |b: usize| ratios[b].len() >= 20 && censored[b] as f64 <= CENSORED * ratios[b].len() as f64;
        let median: Vec<f64> =
            (0..BINS).map(|b| if used(b) { crate::inference::median(ratios[b].clone()) } else { f64::NAN }).collect();
        let kept = || (0..BINS).filter(|b| median[*b].is_finite());
        let n: usize = kept().map(|b| ratios[b].len()).sum();
        if n < FEWEST {
            return None;
        }
        let square = |b: usize| ratios[b].iter().map(|y| (y - median[b]).clamp(-CAP, CAP).powi(2)).sum::<f64>();
        let variance = (kept().map(square).sum::<f64>() / n as f64).max(LEAST_STD.powi(2));
        let mean =
            |of_bin: &dyn Fn(usize) -> f64| kept().map(|b| ratios[b].len() as f64 * of_bin(b)).sum::<f64>() / n as f64;
        let centre = mean(&|b| bins.middle(b));
        let spread = mean(&|b| (bins.middle(b) - centre).powi(2)).sqrt();
        let rounding = (kept().map(|b| rounding[b]).sum::<f64>() / n as f64).sqrt();
        let weight = 1.0 / (DESIGN * variance);
        let mut scale = Scale {
            columns,
            centre,
            spread,
            rounding,
            bins,
            median,
            weight,
            averaging: SVector::zeros(),
            averaging_of_rows: BTreeMap::new(),
        };
        scale.set_averaging(frames);
        Some(scale)
    }

    /// Sets what averaging over neighbours does, from the ratios of simulated returns to their neighbours.
    fn set_averaging(&mut self, frames: &[&FramePair]) {
        // Ratios of the simulated side are about 1.
        let median = self.median.iter().map(|m| 0.0 * m).collect();
        let of_one = Scale { median, columns: [self.columns[1]; 2], ..self.clone() };
        let simulated: Vec<LinearFrame> = frames.par_iter().map(|f| of_one.sums(&f.simulated)).collect();
        let blocks: Vec<usize> = (0..frames.len()).collect();
        let all: Vec<usize> = (0..COLUMNS).collect();
        let fitted = fit(&simulated.iter().collect::<Vec<_>>(), &blocks, &all, &[1.0; COLUMNS]);
        self.averaging = SVector::from_fn(|i, _| fitted.theta[i]);
        let of_one = Scale { averaging: self.averaging, ..of_one };
        let mut rows = BTreeMap::<Group, [f64; 2]>::new();
        for ray in frames.iter().flat_map(|f| &f.simulated) {
            if let (Some(group), Some(s)) = (group_of(ray, Grouping::Row), of_one.sample(ray)) {
                let sum = rows.entry(group).or_default();
                (sum[0], sum[1]) = (sum[0] + s.y, sum[1] + 1.0);
            }
        }
        self.averaging_of_rows = rows.into_iter().map(|(group, [y, n])| (group, y / (n + SHRINKS))).collect();
    }

    /// A ray as a sample; `None` where it is not used.
    pub fn sample(&self, ray: &Ray) -> Option<Sample> {
        let (own, simulated) = (f64::from(ray.intensity), f64::from(ray.intensity_simulated));
        if !ray.smooth || ray.lies() != Lies::On || !own.is_finite() || !(simulated > 0.0) || ray.cos_incidence <= 0.0 {
            return None;
        }
        let ln = simulated.ln();
        let bin = self.bins.of(ln)?;
        let median = Some(self.median[bin]).filter(|m| m.is_finite())?;
        let y = self.columns[0].ln(own) - ln;
        let x = SVector::from([
            1.0,
            (f64::from(ray.range_m) / REFERENCE_M).ln(),
            f64::from(ray.cos_incidence).max(1e-3).ln(),
            ln - self.centre,
            f64::from(u8::from(ray.surface == Surface::Standing)),
            f64::from(u8::from(ray.surface == Surface::Object)),
        ]);
        let y = y.clamp(median - CAP, median + CAP) - x.dot(&self.averaging);
        let of_row = group_of(ray, Grouping::Row).and_then(|group| self.averaging_of_rows.get(&group));
        let y = y - of_row.copied().unwrap_or(0.0);
        Some(Sample { x, y, weight: self.weight, bin })
    }

    /// Sums of the rays of one frame.
    pub fn sums(&self, rays: &[Ray]) -> LinearFrame {
        let mut all = Sums::default();
        rays.iter().filter_map(|r| self.sample(r)).for_each(|s| all.add(&s));
        all.frame()
    }

    /// The same within rows: what is common to the rays of a row in this frame is taken out.
    pub fn sums_within_rows(&self, rays: &[Ray]) -> LinearFrame {
        let mut rows = BTreeMap::<_, Sums>::new();
        for ray in rays {
            if let (Some(group), Some(s)) = (group_of(ray, Grouping::Row), self.sample(ray)) {
                rows.entry(group).or_default().add(&s);
            }
        }
        let mut all = Sums::default();
        for row in rows.into_values() {
            // The first column is 1: its sums are those of the row.
            let (common, weight) = (row.gram.column(GAIN).into_owned(), row.gram[(GAIN, GAIN)]);
            all.gram += row.gram - common * common.transpose() / weight;
            all.right += row.right - common * (row.right[GAIN] / weight);
        }
        all.frame()
    }

    /// Sums of the measured rays of all frames by row, beyond a law.
    pub fn rows(&self, frames: &[FramePair], rig: &Rig, law: &(dyn Fn(&Sample) -> f64 + Sync)) -> Vec<PartedFrame> {
        let half_fov: Vec<f64> = rig.sensors.iter().map(|s| s.half_fov_rad()).collect();
        let one = |frame: &FramePair| -> PartedFrame {
            let mut sums: [BTreeMap<_, GroupSums>; PARTS] = Default::default();
            for ray in &frame.measured {
                let (Some(group), Some(s)) = (group_of(ray, Grouping::Row), self.sample(ray)) else { continue };
                let part = part_of(ray, Grouping::Row, half_fov[usize::from(ray.sensor)]);
                sums[part].entry(group).or_default().merge(&GroupSums {
                    gram: [s.weight, 0.0, 0.0],
                    right: [s.weight * (s.y - law(&s)), 0.0],
                    n: 1.0,
                    weight: s.weight,
                });
            }
            sums.map(|part| part.into_iter().collect())
        };
        frames.par_iter().map(one).collect()
    }

    /// Gains of the `test` frames by tables fitted on the `train` frames, nats: means by kind of surface, range and
    /// simulated intensity, and then by row.
    pub fn by_table(&self, train: &[&FramePair], test: &[&FramePair]) -> Vec<f64> {
        // Of a ray its cell, its row, its ratio and its weight.
        let place = |ray: &Ray| {
            let s = self.sample(ray)?;
            let range = ((f64::from(ray.range_m).max(1.0).ln() / 0.4) as u32).min(15);
            Some(((ray.surface, range, s.bin / 3), (ray.sensor, ray.row), s.y, s.weight))
        };
        let train: Vec<_> = train.iter().flat_map(|f| &f.measured).filter_map(place).collect();
        let mean = |sum: Option<&[f64; 2]>| sum.map_or(0.0, |s| s[0] / (s[1] + SHRINKS));
        let (mut cells, mut rows) = (BTreeMap::<_, [f64; 2]>::new(), BTreeMap::<_, [f64; 2]>::new());
        for (cell, _, y, _) in &train {
            let sum = cells.entry(*cell).or_default();
            (sum[0], sum[1]) = (sum[0] + y, sum[1] + 1.0);
        }
        for (cell, row, y, _) in &train {
            let sum = rows.entry(*row).or_default();
            (sum[0], sum[1]) = (sum[0] + y - mean(cells.get(cell)), sum[1] + 1.0);
        }
        let gain = |f: &&FramePair| {
            let of = |(cell, row, y, weight)| {
                let expected = mean(cells.get(&cell)) + mean(rows.get(&row));
                weight * (expected * y - 0.5 * expected * expected)
            };
            f.measured.iter().filter_map(place).map(of).sum()
        };
        test.iter().map(gain).collect()
    }
}

/// Rays of a cell of a table that its prior counts for.
const SHRINKS: f64 = 40.0;
