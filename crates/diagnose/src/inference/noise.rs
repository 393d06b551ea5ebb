//! Laws of noise: the variance that the measured roughness has beyond the simulated one, by cell.

use super::linear::LinearFrame;
use crate::catalogue::Cause;
use crate::channels::cells::CELLS;
use crate::channels::roughness::{RoughCell, RoughFrame};
use nalgebra::{DMatrix, DVector};
use sensor::signal::{DIAGNOSIS_REFLECTIVITY, signal_index};

/// A law of added variance; each is one column.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum NoiseLaw {
    /// The same everywhere.
    Constant,
    /// Standard deviation grows with range: 1 + growth R.
    Growing(f64),
    /// Standard deviation falls with the signal u: exp(-gamma u / 2).
    Signal(f64),
    /// Directions jitter: (R tan(incidence))^2.
    Angular,
}

/// All laws that are tried.
pub const NOISE_LAWS: [NoiseLaw; 10] = [
    NoiseLaw::Constant,
    NoiseLaw::Angular,
    NoiseLaw::Growing(0.01),
    NoiseLaw::Growing(0.02),
    NoiseLaw::Growing(0.04),
    NoiseLaw::Growing(0.08),
    NoiseLaw::Growing(0.3),
    NoiseLaw::Signal(0.3),
    NoiseLaw::Signal(0.6),
    NoiseLaw::Signal(1.0),
];

/// Signal at which [`NoiseLaw::Signal`] is one.
pub const USUAL_SIGNAL: f64 = 4.0;

/// Largest lever of the direction on the range, m: tangents at grazing incidence are uncertain.
const LONGEST_LEVER_M: f64 = 400.0;

impl NoiseLaw {
    /// The cause that has this law.
    pub fn cause(self) -> Cause {
        match self {
            NoiseLaw::Angular => Cause::AngularJitter,
            NoiseLaw::Signal(_) => Cause::SignalNoise,
            _ => Cause::RangeNoise,
        }
    }

    /// Free parameters.
    pub fn parameters(self) -> usize {
        match self {
            NoiseLaw::Constant | NoiseLaw::Angular => 1,
            NoiseLaw::Growing(_) | NoiseLaw::Signal(_) => 2,
        }
    }

    /// Variance at a range and a cosine of incidence, in units of the coefficient.
    pub fn variance(self, range_m: f64, cos: f64) -> f64 {
        match self {
            NoiseLaw::Constant => 1.0,
            NoiseLaw::Growing(g) => (1.0 + g * range_m).powi(2),
            NoiseLaw::Signal(gamma) => {
                (-gamma * (signal_index(DIAGNOSIS_REFLECTIVITY, cos, range_m) - USUAL_SIGNAL)).exp()
            }
            NoiseLaw::Angular => {
                let lever = range_m * (1.0 / (cos * cos) - 1.0).max(0.0).sqrt();
                lever.min(LONGEST_LEVER_M).powi(2)
            }
        }
    }
}

/// Sums of some frames, for the variances and weights of the cells.
#[derive(Clone, Debug)]
pub struct NoiseTable {
    cells: Vec<RoughCell>,
    used: Vec<bool>,
    /// Smallest variance of a cell, m2.
    least_m2: f64,
}

/// Smallest variance of a cell for fits, m2.
const LEAST_M2: f64 = 1e-8;

/// Smallest variance of a cell in distances between the sides, m2: (2 mm)^2. No LiDAR measures finer. Where the
/// simulated returns of a surface repeat exactly, the likelihood would have no bound.
const LEAST_IN_DISTANCES_M2: f64 = 4e-6;

/// Fewest returns of either side in a cell.
const FEWEST: f64 = 40.0;

/// Returns that count as one: neighbouring returns share neighbours.
const SHARED: f64 = 2.0;

impl NoiseTable {
    /// From the sums over some frames; cells with a cosine of incidence below `least_cos` are left out.
    pub fn new(cells: Vec<RoughCell>, least_cos: f64) -> Self {
        let enough =
            |c: &RoughCell| c.measured.n >= FEWEST && c.simulated.n >= FEWEST && c.simulated.mean().1 > least_cos;
        let used = cells.iter().map(enough).collect();
        NoiseTable { cells, used, least_m2: LEAST_M2 }
    }

    /// From the sums over some frames, for distances between the sides.
    pub fn for_distances(cells: Vec<RoughCell>) -> Self {
        NoiseTable { least_m2: LEAST_IN_DISTANCES_M2, ..NoiseTable::new(cells, 0.0) }
    }

    /// Variances of a cell, measured and simulated, m2; `None` where there are too few returns.
    pub fn variances(&self, cell: usize) -> Option<[f64; 2]> {
        self.used[cell].then(|| self.cells[cell].variances().map(|v| v.max(self.least_m2)))
    }

    /// Linear sums of one frame: differences of the two sides' mean squares over the laws.
    pub fn linear(&self, frame: &RoughFrame, laws: &[NoiseLaw]) -> LinearFrame {
        let k = laws.len();
        let mut out = LinearFrame { gram: DMatrix::zeros(k, k), right: DVector::zeros(k) };
        for (i, cell) in frame {
            let Some([va, vb]) = self.variances(*i as usize) else { continue };
            let (na, nb) = (cell.measured.n, cell.simulated.n);
            if na < 3.0 || nb < 3.0 {
                continue;
            }
            let [ya, yb] = cell.variances();
            let weight = 1.0 / (SHARED * (2.0 * va * va / na + 2.0 * vb * vb / nb));
            let (range, cos) = cell.measured.mean();
            let x = DVector::from_iterator(k, laws.iter().map(|l| l.variance(range, cos)));
            out.right += &x * (weight * (ya - yb));
            out.gram += &x * x.transpose() * weight;
        }
        out
    }

    /// Log likelihood of a frame's measured returns under the simulated variance plus laws with coefficients, nats.
    pub fn likelihood(&self, frame: &RoughFrame, laws: &[(NoiseLaw, f64)]) -> f64 {
        frame
            .iter()
            .filter_map(|(i, cell)| {
                let [_, vb] = self.variances(*i as usize)?;
                let (range, cos) = cell.measured.mean();
                let added: f64 = laws.iter().map(|(l, theta)| theta * l.variance(range, cos)).sum();
                let v = (vb + added).max(0.1 * vb);
                let n = cell.measured.n / SHARED;
                (n > 0.0).then(|| -0.5 * n * (v.ln() + cell.variances()[0] / v))
            })
            .sum()
    }

    /// The same under the ratios of variances of `other` frames by cell: an unconstrained lookup table.
    pub fn likelihood_by_table(&self, frame: &RoughFrame, other: &NoiseTable) -> f64 {
        frame
            .iter()
            .filter_map(|(i, cell)| {
                let [_, vb] = self.variances(*i as usize)?;
                let ratio = other.variances(*i as usize).map_or(1.0, |[a, b]| a / b);
                let (v, n) = (vb * ratio.max(0.1), cell.measured.n / SHARED);
                (n > 0.0).then(|| -0.5 * n * (v.ln() + cell.variances()[0] / v))
            })
            .sum()
    }

    /// Cells with enough returns: mean range, mean cosine, returns, variances.
    pub fn rows(&self) -> Vec<(f64, f64, f64, [f64; 2])> {
        (0..CELLS)
            .filter_map(|i| {
                let v = self.variances(i)?;
                let (range, cos) = self.cells[i].measured.mean();
                Some((range, cos, self.cells[i].measured.n, v))
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::channels::cells::Place;

    #[test]
    fn returns_that_repeat_exactly_are_no_boundless_distance() {
        let place = Place { n: 100.0, ..Place::default() };
        let cell = RoughCell {
            measured: place,
            measured_squares: 100.0 * 0.02f64.powi(2),
            simulated: place,
            simulated_squares: 0.0,
        };
        let mut cells = vec![RoughCell::default(); CELLS];
        cells[0] = cell;
        let table = NoiseTable::for_distances(cells);
        // A hundred times the smallest variance, with half of the returns counted.
        let nats = table.likelihood(&vec![(0, cell)], &[]);
        assert!((nats + 0.5 * 50.0 * (LEAST_IN_DISTANCES_M2.ln() + 100.0)).abs() < 1e-6, "{nats}");
    }
}
