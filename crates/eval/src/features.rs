//! Features of networks: a picture of them (t-SNE), and two numbers that keep what t-SNE does not, linear CKA and the Fréchet distance.

mod cka;
mod frechet;
mod tsne;

pub use cka::{CkaTable, cka_table, linear_cka};
pub use frechet::frechet_distance;
pub use tsne::{Embedded, Embedding, TSNE_SCHEMA, TsneMethod, TsneOptions, tsne};

use nalgebra::DMatrix;

/// Vectors of one length, one a sample.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct Features {
    dim: usize,
    values: Vec<f32>,
}

/// Why features cannot be compared.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum FeatureError {
    /// A value is not a number, or the vectors differ in length.
    #[error("features: {0}")]
    Values(String),
    /// Too few of them.
    #[error("{what} needs at least {least} samples, not {n}")]
    TooFew {
        /// What was asked for.
        what: &'static str,
        /// So many are needed.
        least: usize,
        /// So many are there.
        n: usize,
    },
    /// Two sets that should show the same samples do not.
    #[error("linear CKA compares the same samples in two networks, not {a} and {b} of them")]
    Unpaired {
        /// Samples of the first.
        a: usize,
        /// Samples of the second.
        b: usize,
    },
    /// The setting makes no sense.
    #[error("t-SNE: {0}")]
    Setting(String),
}

impl Features {
    /// From `values` of so many vectors of `dim` values each, one after the other.
    ///
    /// # Shapes
    /// `values`: `[N * dim]`.
    ///
    /// # Errors
    /// Values that are not finite, or that do not fill the last vector.
    pub fn new(dim: usize, values: Vec<f32>) -> Result<Self, FeatureError> {
        if dim == 0 || !values.len().is_multiple_of(dim) {
            return Err(FeatureError::Values(format!("{} values are no vectors of {dim}", values.len())));
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

    /// No sample at all.
    pub fn is_empty(&self) -> bool {
        self.values.is_empty()
    }

    /// Length of a vector.
    pub fn dim(&self) -> usize {
        self.dim
    }

    /// The vectors.
    pub fn rows(&self) -> std::slice::ChunksExact<'_, f32> {
        self.values.chunks_exact(self.dim.max(1))
    }

    /// `[N, dim]`, each column less its mean; and the means.
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
