//! Comparison of network features: t-SNE for display, and linear CKA and the Fréchet distance as metrics.

mod cka;
mod frechet;
mod tsne;

pub use cka::{CkaTable, cka_table, linear_cka};
pub use frechet::frechet_distance;
pub use tsne::{Embedded, Embedding, TSNE_SCHEMA, TsneMethod, TsneOptions, tsne};

use nalgebra::DMatrix;

/// Feature vectors of equal length, one per sample.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct Features {
    dim: usize,
    values: Vec<f32>,
}

/// Why features cannot be compared.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum FeatureError {
    /// A value is not finite, or the vectors differ in length.
    #[error("features: {0}")]
    Values(String),
    /// Not enough samples.
    #[error("{what} needs at least {least} samples, not {n}")]
    TooFew {
        /// The computation.
        what: &'static str,
        /// Minimum number of samples.
        least: usize,
        /// Number of samples given.
        n: usize,
    },
    /// Two feature sets do not hold the same samples.
    #[error("linear CKA compares the same samples in two networks, not {a} and {b} of them")]
    Unpaired {
        /// Samples in the first set.
        a: usize,
        /// Samples in the second set.
        b: usize,
    },
    /// Invalid setting.
    #[error("t-SNE: {0}")]
    Setting(String),
}

impl Features {
    /// From the concatenated vectors of length `dim`.
    ///
    /// # Shapes
    /// `values`: `[N * dim]`.
    ///
    /// # Errors
    /// Non-finite values, or a length that is not a multiple of `dim`.
    pub fn new(dim: usize, values: Vec<f32>) -> Result<Self, FeatureError> {
        if dim == 0 || !values.len().is_multiple_of(dim) {
            return Err(FeatureError::Values(format!("{} values cannot be split into vectors of {dim}", values.len())));
        }
        if let Some(i) = values.iter().position(|v| !v.is_finite()) {
            let message = format!("value {} of sample {} is {}, not a finite number", i % dim, i / dim, values[i]);
            return Err(FeatureError::Values(message));
        }
        Ok(Features { dim, values })
    }

    /// Number of samples.
    pub fn len(&self) -> usize {
        self.values.len() / self.dim.max(1)
    }

    /// Whether there are no samples.
    pub fn is_empty(&self) -> bool {
        self.values.is_empty()
    }

    /// Length of a vector.
    pub fn dim(&self) -> usize {
        self.dim
    }

    /// Iterator over the vectors.
    pub fn rows(&self) -> std::slice::ChunksExact<'_, f32> {
        self.values.chunks_exact(self.dim.max(1))
    }

    /// `[N, dim]` with the column means subtracted; and the column means.
    fn centered(&self) -> (DMatrix<f64>, Vec<f64>) {
        let n = self.len();
        let mut matrix = DMatrix::from_fn(n, self.dim, |i, j| f64::from(self.values[i * self.dim + j]));
        let means: Vec<f64> = matrix.column_iter().map(|column| column.sum() / n as f64).collect();
        for (mut column, mean) in matrix.column_iter_mut().zip(&means) {
            column.add_scalar_mut(-mean);
        }
        (matrix, means)
    }
}
