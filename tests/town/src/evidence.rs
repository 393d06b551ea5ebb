//! Information about effects in linear models: what remains of it when everything else is unknown too.

use nalgebra::{DMatrix, DVector, Matrix6};
use std::collections::BTreeMap;

/// Sums of squares and products of columns, one column for each part of an effect.
#[derive(Clone, Debug)]
pub struct Products {
    sums: DMatrix<f64>,
}

impl Products {
    /// For so many columns.
    pub fn new(columns: usize) -> Products {
        Products { sums: DMatrix::zeros(columns, columns) }
    }

    /// Adds a row with a weight.
    pub fn add(&mut self, row: &[f64], weight: f64) {
        for (i, a) in row.iter().enumerate().filter(|(_, a)| **a != 0.0) {
            for (j, b) in row.iter().enumerate() {
                self.sums[(i, j)] += weight * a * b;
            }
        }
    }

    /// Covariance of the coefficients of all columns when all are unknown; `None` for columns without information.
    pub fn covariance(&self) -> Covariance {
        let used: Vec<usize> = (0..self.sums.nrows()).filter(|&i| self.sums[(i, i)] > LEAST_INFORMATION).collect();
        let n = used.len();
        // Scaled to ones on the diagonal, with a ridge that keeps aliased columns apart.
        let size = DVector::from_iterator(n, used.iter().map(|&i| self.sums[(i, i)].sqrt()));
        let scaled = DMatrix::from_fn(n, n, |i, j| {
            self.sums[(used[i], used[j])] / (size[i] * size[j]) + if i == j { RIDGE } else { 0.0 }
        });
        let inverse = scaled.try_inverse().unwrap_or_else(|| DMatrix::identity(n, n) / RIDGE);
        let matrix = DMatrix::from_fn(n, n, |i, j| inverse[(i, j)] / (size[i] * size[j]));
        Covariance { used, matrix }
    }

    /// The share of the information of a column that is not shared with other columns.
    pub fn own_share(&self, column: usize) -> f64 {
        match self.covariance().variance(column) {
            Some(variance) => (1.0 / (variance * self.sums[(column, column)])).min(1.0),
            None => 1.0,
        }
    }
}

/// Squared standard errors below which a column counts as empty.
const LEAST_INFORMATION: f64 = 1e-8;

/// Ridge on the scaled sums.
const RIDGE: f64 = 1e-7;

/// Covariance of the coefficients of those columns that have information.
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

/// Range residuals as a linear model: columns of effects, the pose of each frame, and an offset of each patch of
/// surface that all frames share.
#[derive(Clone, Debug)]
pub struct Residuals {
    columns: usize,
    /// Columns of effects, then patches in the order of their first appearance.
    sums: DMatrix<f64>,
    patches: BTreeMap<u64, usize>,
    /// Information that was known about each patch before, 1 / m2.
    known: Vec<f64>,
}

/// A residual: its columns, derivative with respect to the pose of its frame, and to the offset of its patch.
#[derive(Clone, Debug)]
pub struct Residual {
    /// Columns of effects, m.
    pub columns: Vec<f64>,
    /// With respect to shift (m) and turn (rad) of the frame.
    pub pose: [f64; 6],
    /// Patch, derivative with respect to its offset, and standard deviation of the offset, m.
    pub patch: (u64, f64, f64),
    /// 1 / variance, 1 / m2.
    pub weight: f64,
}

impl Residuals {
    /// For so many columns.
    pub fn new(columns: usize) -> Residuals {
        let sums = DMatrix::zeros(columns, columns);
        Residuals { columns, sums, patches: BTreeMap::new(), known: Vec::new() }
    }

    /// Adds the residuals of a frame. `pose_std` are the standard deviations of its shift (m) and turn (rad).
    pub fn add_frame(&mut self, residuals: &[Residual], pose_std: [f64; 2]) {
        let mut local: BTreeMap<u64, usize> = BTreeMap::new();
        for r in residuals {
            let next = local.len();
            local.entry(r.patch.0).or_insert(next);
            let (known, new) = (&mut self.known, self.patches.len());
            self.patches.entry(r.patch.0).or_insert_with(|| {
                known.push(1.0 / (r.patch.2 * r.patch.2));
                new
            });
        }
        let n = self.columns + local.len();
        let mut inner = DMatrix::<f64>::zeros(n, n);
        let mut cross = DMatrix::<f64>::zeros(n, 6);
        let mut pose = Matrix6::<f64>::zeros();
        for k in 0..6 {
            pose[(k, k)] = 1.0 / pose_std[k / 3].powi(2);
        }
        for r in residuals {
            let patch = self.columns + local[&r.patch.0];
            let entries: Vec<(usize, f64)> = r
                .columns
                .iter()
                .copied()
                .enumerate()
                .filter(|(_, v)| *v != 0.0)
                .chain(std::iter::once((patch, r.patch.1)))
                .collect();
            for (i, a) in &entries {
                for (j, b) in &entries {
                    inner[(*i, *j)] += r.weight * a * b;
                }
                for k in 0..6 {
                    cross[(*i, k)] += r.weight * a * r.pose[k];
                }
            }
            for j in 0..6 {
                for k in 0..6 {
                    pose[(j, k)] += r.weight * r.pose[j] * r.pose[k];
                }
            }
        }
        let Some(inverse) = pose.try_inverse() else { return };
        inner -= &cross * inverse * cross.transpose();
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

    /// What is known of the columns when poses and patches are unknown.
    pub fn products(&self) -> Products {
        let (c, p) = (self.columns, self.patches.len());
        let mut patches = self.sums.view((c, c), (p, p)).into_owned();
        for (k, known) in self.known.iter().enumerate() {
            patches[(k, k)] += known;
        }
        let cross = self.sums.view((0, c), (c, p)).into_owned();
        let own = self.sums.view((0, 0), (c, c)).into_owned();
        let sums = match patches.cholesky() {
            Some(factor) => own - &cross * factor.solve(&cross.transpose()),
            None => own,
        };
        Products { sums }
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

    #[test]
    fn aliased_columns_have_no_information_of_their_own() {
        let mut products = Products::new(3);
        for i in 0..100 {
            let x = f64::from(i) / 10.0 - 5.0;
            products.add(&[1.0, x, 2.0 * x], 1.0);
        }
        let covariance = products.covariance();
        assert!((covariance.variance(0).unwrap() * 100.0 - 1.0).abs() < 0.01);
        assert!((covariance.squared_errors(&[0]) - 100.0).abs() < 1.0);
        assert!(products.own_share(0) > 0.99 && products.own_share(1) < 1e-5);
    }

    #[test]
    fn an_unknown_pose_of_each_frame_hides_a_column_that_looks_like_it() {
        let frame = |with_pose: bool| -> Vec<Residual> {
            let row = |i: usize| Residual {
                columns: vec![1.0, if i.is_multiple_of(2) { 1.0 } else { -1.0 }],
                pose: [if with_pose { 1.0 } else { 0.0 }, 0.0, 0.0, 0.0, 0.0, 0.0],
                patch: (i as u64 % 4, 0.0, 0.01),
                weight: 1e4,
            };
            (0..50).map(row).collect()
        };
        for (with_pose, expected) in [(false, 10.0 * 50.0 * 1e4), (true, 10.0 / (1.0 / (50.0 * 1e4) + 1e-4))] {
            let mut residuals = Residuals::new(2);
            (0..10).for_each(|_| residuals.add_frame(&frame(with_pose), [0.01, 0.001]));
            let covariance = residuals.products().covariance();
            let found = covariance.squared_errors(&[0]);
            assert!((found / expected - 1.0).abs() < 1e-3, "{found} {expected}");
            assert!((covariance.squared_errors(&[1]) / 5e6 - 1.0).abs() < 1e-3);
        }
    }

    #[test]
    fn an_unknown_patch_is_a_limit_that_more_frames_do_not_move() {
        let mut residuals = Residuals::new(1);
        let row = Residual { columns: vec![1.0], pose: [0.0; 6], patch: (3, 1.0, 0.01), weight: 1e6 };
        (0..100).for_each(|_| residuals.add_frame(&vec![row.clone(); 20], [0.01, 0.001]));
        let found = residuals.products().covariance().squared_errors(&[0]);
        assert!((found / 1e4 - 1.0).abs() < 0.01, "{found}");
    }

    #[test]
    fn likelihood_ratios_of_counts() {
        assert_eq!(poisson_squared_errors(10.0, 20.0), 0.0);
        assert!((poisson_squared_errors(10_100.0, 10_000.0) - 1.0).abs() < 0.02, "small: (found - usual)^2 / usual");
        assert!((2.0 * bernoulli_divergence(0.51, 0.5) - 0.0001 / 0.25).abs() < 1e-5);
    }
}
