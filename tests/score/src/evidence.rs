//! Information about effects in linear models: what remains of it when everything else is unknown too.

use nalgebra::{DMatrix, DVector};
use std::collections::BTreeMap;

/// Squared standard errors below which a column counts as empty.
const LEAST_INFORMATION: f64 = 1e-8;

/// Share of the information without nuisances below which a column counts as empty: it is a rounding error.
const LEAST_SHARE: f64 = 1e-9;

/// Ridge on the scaled sums.
const RIDGE: f64 = 1e-7;

/// Covariance of the coefficients of those columns that have information, when all are unknown.
#[derive(Clone, Debug)]
pub struct Covariance {
    used: Vec<usize>,
    matrix: DMatrix<f64>,
}

impl Covariance {
    fn place(&self, column: usize) -> Option<usize> {
        self.used.binary_search(&column).ok()
    }

    /// Variance of the coefficient of a column.
    pub fn variance(&self, column: usize) -> Option<f64> {
        self.place(column).map(|i| self.matrix[(i, i)])
    }

    /// Squared number of standard errors by which coefficients of 1 of some columns differ from 0.
    pub fn squared_errors(&self, columns: &[usize]) -> f64 {
        let places: Vec<usize> = columns.iter().filter_map(|c| self.place(*c)).collect();
        let n = places.len();
        let block = DMatrix::from_fn(n, n, |i, j| self.matrix[(places[i], places[j])]);
        block.try_inverse().map_or(0.0, |inverse| inverse.sum().max(0.0))
    }
}

/// Observations as a linear model: columns of effects; nuisances that each frame has for itself; and an offset of each
/// patch, which all frames share.
#[derive(Clone, Debug)]
pub struct Model {
    columns: usize,
    /// Columns of effects, then patches in the order of their first appearance.
    sums: DMatrix<f64>,
    /// Information about each column if there were no nuisances.
    bare: Vec<f64>,
    patches: BTreeMap<u64, usize>,
    /// Information that was known about each patch before.
    known: Vec<f64>,
}

/// An observation.
#[derive(Clone, Debug)]
pub struct Row {
    /// What each effect adds to its mean.
    pub columns: Vec<f64>,
    /// Derivatives with respect to the nuisances of its frame.
    pub frame: Vec<f64>,
    /// Patch, derivative with respect to its offset, and standard deviation of the offset.
    pub patch: Option<(u64, f64, f64)>,
    /// 1 / variance.
    pub weight: f64,
}

impl Model {
    /// For so many columns.
    pub fn new(columns: usize) -> Model {
        let sums = DMatrix::zeros(columns, columns);
        Model { columns, sums, bare: vec![0.0; columns], patches: BTreeMap::new(), known: Vec::new() }
    }

    /// Adds the observations of a frame. `stds` are the standard deviations of the nuisances of a frame.
    pub fn add_frame(&mut self, rows: &[Row], stds: &[f64]) {
        let mut local: BTreeMap<u64, usize> = BTreeMap::new();
        for (patch, _, std) in rows.iter().filter_map(|r| r.patch) {
            let next = local.len();
            local.entry(patch).or_insert(next);
            let (known, new) = (&mut self.known, self.patches.len());
            self.patches.entry(patch).or_insert_with(|| {
                known.push(1.0 / (std * std));
                new
            });
        }
        let (n, m) = (self.columns + local.len(), stds.len());
        let mut inner = DMatrix::<f64>::zeros(n, n);
        let mut cross = DMatrix::<f64>::zeros(n, m);
        let mut frame = DMatrix::from_diagonal(&DVector::from_iterator(m, stds.iter().map(|s| 1.0 / (s * s))));
        for r in rows {
            let patch = r.patch.map(|(patch, derivative, _)| (self.columns + local[&patch], derivative));
            let own = r.columns.iter().copied().enumerate().filter(|(_, v)| *v != 0.0);
            let entries: Vec<(usize, f64)> = own.chain(patch).collect();
            for (i, a) in &entries {
                for (j, b) in &entries {
                    inner[(*i, *j)] += r.weight * a * b;
                }
                for k in 0..m {
                    cross[(*i, k)] += r.weight * a * r.frame[k];
                }
            }
            for j in 0..m {
                for k in 0..m {
                    frame[(j, k)] += r.weight * r.frame[j] * r.frame[k];
                }
            }
        }
        for (k, bare) in self.bare.iter_mut().enumerate() {
            *bare += inner[(k, k)];
        }
        if let Some(factor) = frame.cholesky() {
            inner -= &cross * factor.solve(&cross.transpose());
        }
        let wanted = self.columns + self.patches.len();
        if wanted > self.sums.nrows() {
            self.sums = std::mem::replace(&mut self.sums, DMatrix::zeros(0, 0)).resize(wanted, wanted, 0.0);
        }
        let mut place: Vec<usize> = (0..n).collect();
        for (patch, at) in &local {
            place[self.columns + at] = self.columns + self.patches[patch];
        }
        for i in 0..n {
            for j in 0..n {
                self.sums[(place[i], place[j])] += inner[(i, j)];
            }
        }
    }

    /// Covariance of the coefficients of all columns when they and all nuisances are unknown.
    pub fn covariance(&self) -> Covariance {
        let (c, p) = (self.columns, self.patches.len());
        let own = self.sums.view((0, 0), (c, c)).into_owned();
        let mut patches = self.sums.view((c, c), (p, p)).into_owned();
        for (k, known) in self.known.iter().enumerate() {
            patches[(k, k)] += known;
        }
        let cross = self.sums.view((0, c), (c, p)).into_owned();
        let sums = match patches.cholesky() {
            Some(factor) => own - &cross * factor.solve(&cross.transpose()),
            None => own,
        };
        let has_information = |i: &usize| sums[(*i, *i)] > LEAST_INFORMATION + LEAST_SHARE * self.bare[*i];
        let used: Vec<usize> = (0..c).filter(has_information).collect();
        let n = used.len();
        // Scaled to ones on the diagonal, with a ridge that keeps aliased columns apart.
        let size: Vec<f64> = used.iter().map(|&i| sums[(i, i)].sqrt()).collect();
        let scaled = DMatrix::from_fn(n, n, |i, j| {
            sums[(used[i], used[j])] / (size[i] * size[j]) + if i == j { RIDGE } else { 0.0 }
        });
        let inverse = scaled.try_inverse().unwrap_or_else(|| DMatrix::identity(n, n) / RIDGE);
        let matrix = DMatrix::from_fn(n, n, |i, j| inverse[(i, j)] / (size[i] * size[j]));
        Covariance { used, matrix }
    }

    /// The share of the information about a column that remains when nuisances and all other columns are unknown.
    pub fn own_share(&self, covariance: &Covariance, column: usize) -> f64 {
        match covariance.variance(column) {
            Some(variance) => (1.0 / (variance * self.bare[column])).min(1.0),
            None if self.bare[column] > LEAST_INFORMATION => 0.0,
            None => 1.0,
        }
    }
}

/// Squared number of standard errors of `found` events where `usual` are expected: the likelihood ratio of Poisson
/// numbers.
pub fn poisson_squared_errors(found: f64, usual: f64) -> f64 {
    let usual = usual.max(0.3);
    if found <= usual { 0.0 } else { 2.0 * (found * (found / usual).ln() - (found - usual)) }
}

/// Divergence of a Bernoulli variable with probability `p` from one with `q`, nats.
pub fn bernoulli_divergence(p: f64, q: f64) -> f64 {
    let [p, q] = [p, q].map(|v| v.clamp(1e-3, 1.0 - 1e-3));
    p * (p / q).ln() + (1.0 - p) * ((1.0 - p) / (1.0 - q)).ln()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(columns: &[f64], frame: &[f64], patch: Option<(u64, f64, f64)>, weight: f64) -> Row {
        Row { columns: columns.to_vec(), frame: frame.to_vec(), patch, weight }
    }

    #[test]
    fn aliased_columns_have_no_information_of_their_own() {
        let mut model = Model::new(3);
        let x = |i: u32| f64::from(i) / 10.0 - 4.95;
        let rows: Vec<Row> = (0..100).map(|i| row(&[1.0, x(i), 2.0 * x(i)], &[], None, 1.0)).collect();
        model.add_frame(&rows, &[]);
        let covariance = model.covariance();
        assert!((covariance.variance(0).unwrap() * 100.0 - 1.0).abs() < 0.01);
        assert!((covariance.squared_errors(&[0]) - 100.0).abs() < 1.0);
        assert!(model.own_share(&covariance, 0) > 0.99 && model.own_share(&covariance, 1) < 1e-5);
    }

    #[test]
    fn an_unknown_nuisance_of_each_frame_hides_a_column_that_looks_like_it() {
        for (size, expected) in [(0.0, 10.0 * 50.0 * 1e4), (1.0, 10.0 / (1.0 / (50.0 * 1e4) + 1e-4))] {
            let of_frame = |i: usize| row(&[1.0, if i.is_multiple_of(2) { 1.0 } else { -1.0 }], &[size], None, 1e4);
            let rows: Vec<Row> = (0..50).map(of_frame).collect();
            let mut model = Model::new(2);
            (0..10).for_each(|_| model.add_frame(&rows, &[0.01]));
            let covariance = model.covariance();
            let found = covariance.squared_errors(&[0]);
            assert!((found / expected - 1.0).abs() < 1e-3, "{found} {expected}");
            assert!((covariance.squared_errors(&[1]) / 5e6 - 1.0).abs() < 1e-3);
        }
    }

    #[test]
    fn an_unknown_patch_is_a_limit_that_more_frames_do_not_move() {
        let mut model = Model::new(1);
        let rows = vec![row(&[1.0], &[0.0], Some((3, 1.0, 0.01)), 1e6); 20];
        (0..100).for_each(|_| model.add_frame(&rows, &[0.01]));
        let found = model.covariance().squared_errors(&[0]);
        assert!((found / 1e4 - 1.0).abs() < 0.01, "{found}");
    }

    #[test]
    fn likelihood_ratios_of_counts() {
        assert_eq!(poisson_squared_errors(10.0, 20.0), 0.0);
        assert!((poisson_squared_errors(10_100.0, 10_000.0) - 1.0).abs() < 0.02, "small: (found - usual)^2 / usual");
        assert!((2.0 * bernoulli_divergence(0.51, 0.5) - 0.0001 / 0.25).abs() < 1e-5);
    }
}
