//! Roughness: the distance of each return from the surface through its neighbours of the same side. Poses, labels and
//! errors of walls cancel; noise of the range and of the direction does not.

use super::cells::{CELLS, Place, cell};
use super::groups::{Group, GroupSums, Grouping, PARTS, PartedFrame, group_of, part_of};
use crate::pairing::{FramePair, Ray, Surface};
use rayon::prelude::*;
use sensor::Rig;

/// Sums of one cell of one frame.
#[derive(Clone, Copy, Debug, Default)]
pub struct RoughCell {
    /// Measured returns.
    pub measured: Place,
    /// Sum of their squared roughness, m2, each at most that of [`CAP`] scales of the cell.
    pub measured_squares: f64,
    /// Simulated returns.
    pub simulated: Place,
    /// Sum of their squared roughness, m2.
    pub simulated_squares: f64,
}

impl RoughCell {
    /// Adds another sum.
    pub fn merge(&mut self, other: &RoughCell) {
        self.measured.merge(&other.measured);
        self.simulated.merge(&other.simulated);
        self.measured_squares += other.measured_squares;
        self.simulated_squares += other.simulated_squares;
    }

    /// Variances of the two sides, m2.
    pub fn variances(&self) -> [f64; 2] {
        [self.measured_squares / self.measured.n.max(1.0), self.simulated_squares / self.simulated.n.max(1.0)]
    }
}

/// Cells of one frame: those that hold something, by number.
pub type RoughFrame = Vec<(u32, RoughCell)>;

/// Largest roughness that counts, in standard deviations.
pub const CAP: f64 = 4.0;

/// Number of bins of the logarithm of the roughness, for medians.
const LOG_BINS: usize = 56;

fn log_bin(v: f64) -> usize {
    ((v.max(1e-9).log2() + 20.0) * 2.0).clamp(0.0, LOG_BINS as f64 - 1.0) as usize
}

/// Roughness in units of the noise of one range, m. `None` at objects that the simulation does not show there.
pub fn own_roughness_m(ray: &Ray) -> Option<f64> {
    if ray.at_object && ray.surface != Surface::Object {
        return None;
    }
    let value = f64::from(ray.roughness_m) / (1.0 + f64::from(ray.roughness_leverage)).sqrt();
    value.is_finite().then_some(value)
}

/// Robust scale of each cell, m: the larger of the two sides' medians of |roughness|, over 0.6745.
pub fn scales(frames: &[FramePair]) -> Vec<f64> {
    let count = |rays: &[Ray]| {
        let mut counts = vec![0u32; CELLS * LOG_BINS];
        for ray in rays {
            if let (Some(c), Some(v)) = (cell(ray), own_roughness_m(ray)) {
                counts[c * LOG_BINS + log_bin(v.abs())] += 1;
            }
        }
        counts
    };
    let both = [0, 1].map(|side| {
        let rays = |f: &FramePair| count(if side == 0 { &f.measured } else { &f.simulated });
        frames
            .par_iter()
            .fold(|| vec![0u32; CELLS * LOG_BINS], |sum, f| add(sum, &rays(f)))
            .reduce(|| vec![0u32; CELLS * LOG_BINS], |x, y| add(x, &y))
    });
    (0..CELLS)
        .map(|c| {
            let median = |counts: &[u32]| {
                let counts = &counts[c * LOG_BINS..(c + 1) * LOG_BINS];
                let half = counts.iter().sum::<u32>() / 2;
                let mut below = 0;
                let bin = counts.iter().position(|n| {
                    below += n;
                    below > half
                });
                bin.map_or(0.0, |b| ((b as f64 + 0.5) / 2.0 - 20.0).exp2())
            };
            median(&both[0]).max(median(&both[1])) / statistics::MEDIAN_OF_NORMAL
        })
        .collect()
}

fn add(mut sum: Vec<u32>, other: &[u32]) -> Vec<u32> {
    sum.iter_mut().zip(other).for_each(|(s, o)| *s += o);
    sum
}

/// The cells of every frame.
pub fn rough_frames(frames: &[FramePair], scales: &[f64]) -> Vec<RoughFrame> {
    let one = |frame: &FramePair| -> RoughFrame {
        let mut cells = vec![RoughCell::default(); CELLS];
        for (side, rays) in [&frame.measured, &frame.simulated].into_iter().enumerate() {
            for ray in rays {
                let (Some(c), Some(v)) = (cell(ray), own_roughness_m(ray)) else { continue };
                let square = v.abs().min(CAP * scales[c]).powi(2);
                if side == 0 {
                    cells[c].measured.add(ray);
                    cells[c].measured_squares += square;
                } else {
                    cells[c].simulated.add(ray);
                    cells[c].simulated_squares += square;
                }
            }
        }
        let held = |c: &RoughCell| c.measured.n + c.simulated.n > 0.0;
        cells.into_iter().enumerate().filter(|(_, c)| held(c)).map(|(i, c)| (i as u32, c)).collect()
    };
    frames.par_iter().map(one).collect()
}

/// Sums over frames.
pub fn total<'a>(frames: impl Iterator<Item = &'a RoughFrame>) -> Vec<RoughCell> {
    let mut sum = vec![RoughCell::default(); CELLS];
    for (i, cell) in frames.flatten() {
        sum[*i as usize].merge(cell);
    }
    sum
}

/// Excess variance of the measured returns of groups of directions over `expected`, in units of it, as sums of every
/// frame. `variances` gives the two sides' variances of a cell, `expected` the measured variance in units of the
/// simulated one.
pub fn rough_groups(
    frames: &[FramePair],
    rig: &Rig,
    scales: &[f64],
    grouping: Grouping,
    variances: &(dyn Fn(usize) -> Option<[f64; 2]> + Sync),
    expected: &(dyn Fn(usize, &Ray) -> f64 + Sync),
) -> Vec<PartedFrame> {
    let half_fov: Vec<f64> = rig.sensors.iter().map(|s| s.half_fov_rad()).collect();
    let one = |frame: &FramePair| -> PartedFrame {
        // Of each side: returns, sum of the squares minus their expectation, sum of the variances of the squares.
        let mut sums = std::collections::BTreeMap::<(Group, usize), [[f64; 3]; 2]>::new();
        for (side, rays) in [&frame.measured, &frame.simulated].into_iter().enumerate() {
            for ray in rays {
                let (Some(c), Some(v), Some(g)) = (cell(ray), own_roughness_m(ray), group_of(ray, grouping)) else {
                    continue;
                };
                let Some([va, vb]) = variances(c) else { continue };
                let square = v.abs().min(CAP * scales[c]).powi(2) / vb;
                let (mean, spread) = if side == 0 { (expected(c, ray).max(0.1), va / vb) } else { (1.0, 1.0) };
                let sum =
                    &mut sums.entry((g, part_of(ray, grouping, half_fov[ray.sensor as usize]))).or_default()[side];
                sum[0] += 1.0;
                sum[1] += square / mean - 1.0;
                sum[2] += 2.0 * (spread / mean).powi(2);
            }
        }
        let mut out: PartedFrame = [const { Vec::new() }; PARTS];
        for ((g, part), [a, b]) in sums.into_iter().filter(|(_, [a, b])| a[0] >= 5.0 && b[0] >= 5.0) {
            let y = a[1] / a[0] - b[1] / b[0];
            // Neighbouring returns share neighbours: half of the weight.
            let w = 1.0 / (2.0 * (a[2] / (a[0] * a[0]) + b[2] / (b[0] * b[0])));
            out[part].push((g, GroupSums { gram: [w, 0.0, 0.0], right: [w * y, 0.0], n: a[0], weight: w }));
        }
        out
    };
    frames.par_iter().map(one).collect()
}
